"""Evaluators of environments in Python: real learners, real workers, real faults."""

import atexit
import json
import os
import pathlib
import random
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import quad_rl

OBSERVATION = 11
SMALL = ["--agent", "actor.hidden=[16]", "--agent", "critic.hidden=[16]", "--agent", "critics=2", "--set", "batch_size=16"]


class Walk:
    """Ten lines, no Gymnasium: walk to the origin."""

    def reset(self, seed=None):
        self.state, self.steps = np.random.default_rng(seed).normal(size=OBSERVATION), 0
        return self.state, {}

    def step(self, action):
        self.steps += 1
        self.state = self.state + 0.1 * np.resize(action, OBSERVATION)
        info = {"success": bool(self.state[0] > 0)}
        return self.state, -float(np.abs(self.state).sum()), False, self.steps >= 20, info


class Learner:
    """A learner at work, and the folder of its run."""

    def __init__(self, folder, data, *arguments, environment="walk", listen="tcp/127.0.0.1:0", steps=60, interval=20, episodes=8):
        self.folder = folder
        command = ["learner", "train", "--task", "own-data", "--env", environment, "--dataset", str(data)]
        command += ["--run-dir", str(folder), "--listen", listen, *SMALL]
        command += ["--steps", str(steps), "--eval-interval", str(interval), "--episodes", str(episodes)]
        command += arguments
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
        atexit.register(self.process.kill)  # One that a failed test has left.
        endpoints = folder / "endpoints.json"
        wait(lambda: endpoints.exists() or self.process.poll() is not None)
        assert endpoints.exists(), self.process.stderr.read()
        self.endpoint = json.loads(endpoints.read_text())["zenoh"][0]

    def end(self, timeout=600):
        """Exit code and output."""
        said = self.process.communicate(timeout=timeout)[1]
        return self.process.returncode, said

    def scores(self):
        path = self.folder / "scores.jsonl"
        return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []

    def snapshot(self, step):
        return self.folder / f"snapshots/step_{step:09}.safetensors"


def wait(condition, seconds=600):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "it took too long"
        time.sleep(0.02)


def verified(folder):
    return subprocess.run(["learner", "verify", str(folder)], capture_output=True, timeout=600).returncode == 0


def by_hand(policy, seed):
    """The return of an episode, as an evaluator runs it."""
    walk, episode = Walk(), policy.begin([seed])
    observation, _ = walk.reset(seed=seed % 2**31)
    total, truncated = 0.0, False
    while not truncated:
        observation, reward, _, truncated, _ = walk.step(episode.act(observation[None])[0])
        total += reward
    return total


def test_scores_equal_those_of_stepping_by_hand(tmp_path, data):
    learner = Learner(tmp_path / "run", data)
    with quad_rl.Evaluators("walk", lambda seed: Walk(), connect=learner.endpoint, workers=2):
        code, said = learner.end()
    assert code == 0, said
    scores = learner.scores()
    assert len(scores) == 3 * 8 and verified(learner.folder)
    policy = quad_rl.Policy.load(learner.snapshot(60))
    for score in scores:
        assert score["score"] == score["return"] and score["length"] == 20
        if score["step"] == 60:
            assert score["return"] == by_hand(policy, score["seed"])


def test_gymnasium_by_id_with_references(tmp_path, data):
    learner = Learner(tmp_path / "run", data, environment="pogo", steps=20)
    with quad_rl.Evaluators("pogo", "Hopper-v5", connect=learner.endpoint, workers=1, score=(0.0, 50.0)):
        code, said = learner.end()
    assert code == 0, said
    for score in learner.scores():
        assert score["score"] == pytest.approx(2.0 * score["return"], rel=1e-12) and score["return"] != 0.0


def test_success_is_a_rate(tmp_path, data, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path, tmp_path])  # A Path, which Python ignores.
    learner = Learner(tmp_path / "run", data, steps=20)
    with quad_rl.Evaluators("walk", lambda seed: Walk(), connect=learner.endpoint, workers=1, score="success"):
        assert learner.end()[0] == 0
    scores = [score["score"] for score in learner.scores()]
    assert set(scores) == {0.0, 100.0}
    report = subprocess.run(["learner", "report", str(learner.folder)], capture_output=True, text=True, timeout=600).stdout
    assert ["step", "episodes", "score", "return", "length"] in [line.split() for line in report.splitlines()]
    assert f" {np.mean(scores):.2f} ± " in report and "dataset" not in report


def test_an_error_of_the_environment_is_reported_and_counts_as_an_attempt(tmp_path, data):
    marker = tmp_path / "broken"

    class Breaks(Walk):
        def step(self, action):
            if self.steps == 5 and not marker.exists():
                marker.touch()
                raise ValueError("the cable is loose")
            return super().step(action)

    learner = Learner(tmp_path / "run", data, steps=20)
    with quad_rl.Evaluators("walk", lambda seed: Breaks(), connect=learner.endpoint, workers=1):
        code, said = learner.end()
    assert code == 0 and len(learner.scores()) == 8, said
    assert re.search(r'"walk" failed: ValueError: the cable is loose \(.*:\d+, in step\)', said), said


def test_a_nan_reward_is_reported_at_once_and_counts_as_an_attempt(tmp_path, data):
    marker = tmp_path / "broken"

    class Pays(Walk):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            if self.steps == 5 and not marker.exists():
                marker.touch()
                reward = float("nan")
            return observation, reward, *rest

    learner = Learner(tmp_path / "run", data, steps=20)
    with quad_rl.Evaluators("walk", lambda seed: Pays(), connect=learner.endpoint, workers=1):
        code, said = learner.end()
    assert code == 0 and len(learner.scores()) == 8, said
    assert re.search(r"could not do a job .* the return of the episode with seed \d+ is NaN after 5 steps", said), said


def test_killed_workers_restart_and_lose_no_score(tmp_path, data):
    # One pool for two runs: Python's workers have one environment, the programs' evaluators the other.
    ours = Learner(tmp_path / "ours", data, steps=3000)
    theirs = Learner(tmp_path / "theirs", data, environment="hopper", steps=1000)
    both = [ours.endpoint, theirs.endpoint]
    command = ["evaluator", "serve", *[word for endpoint in both for word in ("--connect", endpoint)]]
    programs = [subprocess.Popen(command, stderr=subprocess.DEVNULL) for _ in range(2)]
    rng = random.Random(7)
    with quad_rl.Evaluators("walk", lambda seed: Walk(), connect=both, workers=3) as evaluators:
        for _ in range(20):
            processes = [worker.process for worker in evaluators._workers]
            victims = [process.pid for process in processes if process.poll() is None]
            if victims:
                os.kill(rng.choice(victims), signal.SIGKILL)
            time.sleep(rng.uniform(0.0, 0.6))
        for learner, scores in (ours, 150 * 8), (theirs, 50 * 8):
            code, said = learner.end()
            assert code == 0, said
            assert len(learner.scores()) == scores and verified(learner.folder)
    for program in programs:
        program.terminate()
        assert program.wait(600) == 0


def run(script, *arguments):
    """Runs a script that must end, however long its forked children sleep."""
    ended = subprocess.run([sys.executable, "-c", script, *map(str, arguments)], cwd=pathlib.Path(__file__).parent, capture_output=True, timeout=600)
    assert ended.returncode == 0, ended.stderr.decode()


FORKING_ENVIRONMENT = """
import multiprocessing, os, signal, time
import quad_rl, test_evaluate

def make(seed):
    multiprocessing.get_context("fork").Process(target=time.sleep, args=(3600,)).start()
    return test_evaluate.Walk()

groups = []
with quad_rl.Evaluators("walk", make, connect="tcp/127.0.0.1:1", workers=1) as evaluators:
    worker = evaluators._workers[0]
    groups.append(worker.process.pid)
    worker.process.kill()
    test_evaluate.wait(lambda: worker.process.pid != groups[0])
    groups.append(worker.process.pid)
    worker.wait_until_ready()
for group in groups:
    os.killpg(group, signal.SIGKILL)
"""


def test_a_killed_worker_with_a_forked_child_restarts_and_ends():
    run(FORKING_ENVIRONMENT)


FORK = """
import os, signal, time
import quad_rl, test_evaluate

with quad_rl.Evaluators("walk", lambda seed: test_evaluate.Walk(), connect="tcp/127.0.0.1:1", workers=2) as evaluators:
    forks = []
    for stops in (True, False):
        forks.append(os.fork())
        if forks[-1] == 0:
            if stops:
                evaluators.stop()
            time.sleep(3600)
            os._exit(0)
    time.sleep(1)
    assert all(worker.process.poll() is None for worker in evaluators._workers), "a fork has ended them"
[os.kill(fork, signal.SIGKILL) for fork in forks]
codes = [worker.process.returncode for worker in evaluators._workers]
assert -signal.SIGKILL not in codes, codes
"""


def test_a_fork_of_the_parent_does_not_stop_the_workers():
    run(FORK)


def test_gives_up_a_worker_that_keeps_ending(tmp_path, monkeypatch):
    monkeypatch.setattr("quad_rl._process._ENDS", 3)
    made = tmp_path / "made"

    def make(seed):
        if made.exists():
            os._exit(3)
        made.touch()
        return Walk()

    evaluators = quad_rl.Evaluators("walk", make, connect="tcp/127.0.0.1:1", workers=1)
    try:
        evaluators._workers[0].process.kill()
        wait(evaluators._stopping.is_set)
    finally:
        evaluators.stop()
    with pytest.raises(RuntimeError, match="ended 3 times in a row soon after its start .exit code 3.; its standard error"):
        evaluators.wait()


SCRIPT = """
import os, time
import quad_rl, test_evaluate

evaluators = quad_rl.Evaluators("walk", lambda seed: test_evaluate.Walk(), connect="tcp/127.0.0.1:1", workers=2)
if os.fork() == 0:
    time.sleep(3600)
    os._exit(0)
evaluators.wait()
"""


def children(of):
    return pathlib.Path(f"/proc/{of}/task/{of}/children").read_text().split()


def has_ended(process):
    """True if it is gone, or was not waited for."""
    try:
        return ") Z" in pathlib.Path(f"/proc/{process}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(by):
    process = subprocess.Popen([sys.executable, "-c", SCRIPT], cwd=pathlib.Path(__file__).parent, stderr=subprocess.PIPE)
    wait(lambda: len(children(process.pid)) == 3)
    *workers, fork = children(process.pid)
    for _ in range(2):  # Both are ready.
        while b"ready to serve" not in process.stderr.readline():
            assert process.poll() is None
    process.send_signal(by)
    # A Ctrl-C may come before it waits.
    assert process.wait(600) in ((-by,) if by == signal.SIGKILL else (0, 1, -by, 130))
    wait(lambda: all(map(has_ended, workers)))
    os.kill(int(fork), signal.SIGKILL)
    process.stderr.close()


def test_refuses_invalid_arguments():
    def refused(kind, words, *arguments, **keywords):
        with pytest.raises(kind, match=words):
            quad_rl.Evaluators(*arguments, **keywords)

    refused(ValueError, "evaluator serve. simulates", "hopper", "Hopper-v5")
    refused(ValueError, "a Gymnasium id, or a function", "walk", Walk())
    refused(ValueError, "at least 1", "walk", lambda seed: Walk(), workers=0)
    refused(ValueError, '"return", "success" or a pair', "walk", lambda seed: Walk(), score="best")
    refused(ValueError, "not .3.0, 3.0.", "walk", lambda seed: Walk(), score=(3.0, 3.0))
    refused(RuntimeError, "ZeroDivisionError", "walk", lambda seed: 1 // 0, workers=1)
    refused(RuntimeError, "SystemExit: no license", "walk", lambda seed: sys.exit("no license"), workers=1)
    refused(RuntimeError, "before it had an environment .exit code 3.", "walk", lambda seed: os._exit(3), workers=1)
    refused(RuntimeError, "No module named|doesn't exist|NameNotFound", "walk", "NoSuch-v0", workers=1)
    refused(RuntimeError, 'the environment "walk": actions must be a box of floats', "walk", "CartPole-v1", workers=1)


FORM = """
import subprocess, sys
import quad_rl, test_evaluate

class Old(test_evaluate.Walk):
    def step(self, action):
        return super().step(action)[:4]

learner = test_evaluate.Learner(test_evaluate.pathlib.Path(sys.argv[1]), sys.argv[2], steps=20)
try:
    with quad_rl.Evaluators("walk", lambda seed: Old(), connect=learner.endpoint, workers=1):
        learner.process.wait()
except RuntimeError as error:
    assert 'the environment "walk": step must return' in str(error), error
    assert learner.process.poll() is None
    sys.exit(0)
sys.exit("it went on")
"""


def test_an_old_environment_without_spaces_ends_the_program_that_waits_for_it(tmp_path, data):
    run(FORM, tmp_path / "run", data)


def test_a_failure_to_connect_is_reported():
    with pytest.raises(RuntimeError, match="udp"):
        quad_rl.evaluate("walk", lambda seed: Walk(), connect="udp/127.0.0.1:1", workers=1)
