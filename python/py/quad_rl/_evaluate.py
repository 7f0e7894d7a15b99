"""Evaluators for environments that Python moves."""

import json
import os
import subprocess
import sys
import threading
import time

import cloudpickle

from quad_rl import _quad_rl

# A worker that was killed is started again after this time, seconds.
_AGAIN = 1.0
# Workers get this long to deliver their scores and leave, seconds.
_LEAVE = 12.0


class Evaluators:
    """Worker processes that evaluate a learner's policies in an environment of yours, until `stop()`.

    With `with`, they are there inside the block:

        with quad_rl.Evaluators("my-robot", lambda seed: MyEnv(), workers=2):
            subprocess.run(["learner", "train", ...])

    Arguments are those of `quad_rl.evaluate`.
    """

    def __init__(self, name, environment, *, connect="tcp/127.0.0.1:7447", certificates=None, workers=None,
                 score="return", precision="f32"):
        if name in _quad_rl.simulated():
            raise ValueError(f'"{name}" is an environment that `evaluator serve` simulates; choose another name')
        if isinstance(environment, str):
            environment = _Gymnasium(environment)
        if not callable(environment):
            raise ValueError("environment must be a Gymnasium id, or a function that takes a seed and gives an environment")
        workers = len(os.sched_getaffinity(0)) if workers is None else workers
        if workers < 1:
            raise ValueError(f"workers is {workers}, but must be at least 1")
        connect = [connect] if isinstance(connect, str) else list(connect)
        serve = {"connect": connect, "certificates": certificates, "precision": precision}
        task = {"name": name, "make": environment, "score": _score(score), "seed": 0, "serve": serve}
        self._payload = [json.dumps(sys.path).encode(), cloudpickle.dumps(task)]
        self._stopping = threading.Event()
        self._error = None
        self._processes = [None] * workers
        try:
            self._processes = [self._start() for _ in range(workers)]
            for process in self._processes:
                self._sizes(process)
        except BaseException:
            self.stop()
            raise
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def _start(self):
        environment = {"RAYON_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **os.environ}
        # A session of its own: a terminal's Ctrl-C is this process's to pass on.
        process = subprocess.Popen([sys.executable, "-m", "quad_rl._worker"], stdin=subprocess.PIPE,
                                   stdout=subprocess.PIPE, env=environment, start_new_session=True)
        try:
            for part in self._payload:
                process.stdin.write(len(part).to_bytes(8, "little") + part)
            process.stdin.flush()
        except BrokenPipeError:
            pass  # It has ended, which its answer tells.
        return process

    def _sizes(self, process):
        answer = process.stdout.readline()
        if not answer:
            raise RuntimeError("a worker ended before it had an environment; its standard error says why")
        self._check(answer)

    def _check(self, line):
        error = json.loads(line).get("error")
        if error is not None:
            raise RuntimeError(error)

    def _watch(self):
        """Starts a worker again that was killed. One that cannot work ends them all."""
        while not self._stopping.wait(_AGAIN):
            for place, process in enumerate(self._processes):
                if process.poll() is None:
                    continue
                try:
                    for line in process.stdout:
                        self._check(line)
                    process.stdin.close()
                    process.stdout.close()
                    print(f"quad_rl: a worker ended with {process.returncode}; it is started again", file=sys.stderr)
                    self._processes[place] = self._start()
                    self._sizes(self._processes[place])
                except (RuntimeError, OSError) as error:
                    self._error = error
                    self._stopping.set()
                    return

    def wait(self):
        """Waits until the workers are stopped: by Ctrl-C, after which they leave in order, or by `stop()` of another thread.

        Raises RuntimeError if they cannot work.
        """
        try:
            while not self._stopping.wait(0.2):
                pass
        finally:
            self.stop()
        if self._error is not None:
            raise self._error

    def stop(self):
        """Lets the workers deliver the scores that they have, hand back the jobs that they have begun, and end."""
        self._stopping.set()
        watcher = getattr(self, "_watcher", None)
        if watcher is not None and watcher is not threading.current_thread():
            watcher.join()
        there = [process for process in self._processes if process is not None]
        for process in there:
            try:
                process.stdin.close()
            except OSError:
                pass
        until = time.monotonic() + _LEAVE
        for process in there:
            try:
                process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            process.stdout.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.stop()
        if self._error is not None:
            raise self._error


def evaluate(name, environment, **arguments):
    """Evaluates learners' policies in an environment of yours until Ctrl-C: `evaluator serve` for any environment.

    name: what the learner's run calls the environment: `learner train --task own-data --set environment=NAME`.
    environment: a Gymnasium id, or a function that takes a seed and gives an environment: an object with `reset(seed=…)`,
        which gives (observation, info), and `step(action)`, which gives (observation, reward, terminated, truncated, info),
        as in Gymnasium. The seed is the run's, the same for all episodes. Observations are flattened to one row of numbers.
    connect: where the learner or a router listens, or a list of such places.
    certificates: folder with ca.pem, cert.pem and key.pem, for endpoints like "tls/HOST:PORT".
    workers: processes, each with one job at a time [default: one a core].
    score: "return"; or "success", 100 if the last info's "success" (or "is_success") is true, else 0; or a pair (low, high)
        of returns that score 0 and 100.
    precision: arithmetic of the policy, "f32" or "bf16".

    What the environment raises is logged, told to the learner in one line, and costs the episode an attempt.
    Raises ValueError for arguments that cannot be, RuntimeError if the environment cannot be made.
    """
    Evaluators(name, environment, **arguments).wait()


class _Gymnasium:
    """Makes environments by their id."""

    def __init__(self, name):
        self.name = name

    def __call__(self, _seed):
        import gymnasium

        return gymnasium.make(self.name)


def _score(score):
    if score in ("return", "success"):
        return score
    try:
        low, high = (float(value) for value in score)
    except (TypeError, ValueError):
        low = high = 0.0
    if not low < high:
        raise ValueError(f'score must be "return", "success" or a pair (low, high) of returns, not {score!r}')
    return low, high
