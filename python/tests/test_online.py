"""Online learning in a Python environment: the same run for any number of evaluators, whatever is killed."""

import subprocess

import h5py
import numpy as np

import quad_rl
from conftest import free_endpoint
from test_evaluate import Learner, Walk, wait

ROWS = 1_000


class Fall(Walk):
    """Ends where it falls, so that the policy decides how long an episode is."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, reward, bool(abs(self.state[1]) > 1.5), truncated, info


def learner(folder, data, **arguments):
    online = ["--online-steps", str(ROWS), "--checkpoint-seconds", "0"]
    for value in "warmup=100", "lag=3", "snapshot_interval=50":
        online += ["--set", f"online.{value}"]
    return Learner(folder, data, *online, interval=500, episodes=2, **arguments)


def evaluators(learner, workers, environment=Fall):
    return quad_rl.Evaluators("walk", lambda seed: environment(), connect=learner.endpoint, workers=workers)


def checkpoint(folder):
    return max((folder / "checkpoints").glob("step_*")).read_bytes()


def experience(folder):
    """The rows of each episode, by its first."""
    file = folder / "experience.hdf5"
    subprocess.run(["learner", "export-data", str(folder), "--out", str(file)], check=True, capture_output=True, timeout=600)
    with h5py.File(file) as data:
        ends = np.flatnonzero(data["terminals"][:] | data["timeouts"][:]) + 1
        rows = np.hstack([data["observations"][:], data["actions"][:], data["rewards"][:][:, None]])
    episodes = np.split(rows, ends[:-1])
    assert len(rows) >= ROWS and len({len(episode) for episode in episodes}) > 5
    by_first = {episode[0].tobytes(): episode.tobytes() for episode in episodes}
    assert len(by_first) == len(episodes), "an episode is there twice"
    return by_first


def test_any_number_of_evaluators_and_any_kill_make_the_same_run(tmp_path, data):
    folders = [tmp_path / name for name in ("of-1", "of-4", "killed")]
    for workers, folder in zip((1, 4), folders):
        whole = learner(folder, data)
        with evaluators(whole, workers):
            code, said = whole.end()
        assert code == 0, said
    killed = learner(folders[-1], data, listen=free_endpoint())
    log = folders[-1] / "experience.log"
    with evaluators(killed, 2) as pool:
        for kill in range(4):
            before = log.stat().st_size if log.exists() else 0
            wait(lambda: log.exists() and log.stat().st_size > before)
            pool._workers[kill % 2].process.kill()
            assert killed.process.poll() is None, "it has ended before"
            killed.process.kill()
            killed.end()
            killed = learner(folders[-1], data, listen=killed.endpoint)
        code, said = killed.end()
    assert code == 0, said

    first, *others = [(checkpoint(folder), experience(folder)) for folder in folders]
    for weights, episodes in others:
        assert weights == first[0]
        # At the end, one run may have an episode more than it needs.
        common = first[1].keys() & episodes.keys()
        assert len(common) >= max(len(first[1]), len(episodes)) - 3
        assert all(first[1][key] == episodes[key] for key in common)
    verified = subprocess.run(["learner", "verify", str(folders[-1])], capture_output=True, text=True, timeout=600)
    assert verified.returncode == 0 and "bit for bit by evaluators with the same arithmetic" in verified.stdout, verified


def test_learns_without_a_dataset(tmp_path):
    networks, endpoint = {"actor.hidden": [16], "critic.hidden": [16]}, free_endpoint()
    with quad_rl.Evaluators("walk", lambda seed: Fall(), connect=endpoint, workers=1):
        lengths = {"online_steps": 1_500, "eval_interval": 500, "episodes": 2}
        run = quad_rl.train(env="walk", algorithm="sac", run_dir=tmp_path / "run", listen=endpoint, agent=networks, set={"sizes": [11, 3]}, **lengths)
    assert [(score["step"], score["environment_steps"]) for score in run.scores] == [(500, 1_500)]
    assert run.scores[0]["dataset_score"] is None and run.policy().action_size == 3


class Glitches(Fall):
    """In some online episodes it diverges, in some a sensor gives 1e30 once. Its space is narrower than the data's actions."""

    def reset(self, seed=None, options=None):
        self.glitch = seed % 4 if options else 0
        return super().reset(seed)

    def step(self, action):
        observation, *rest = super().step(np.clip(action, -0.5, 0.5))
        if self.steps >= 2 and self.glitch:
            observation = observation.copy()
            observation[3] = {1: np.nan, 2: 1e30, 3: observation[3]}[self.glitch]
        return observation, *rest


class Narrow(Glitches):
    action_space = type("Box", (), {"shape": (3,), "low": np.float32([-0.5] * 3), "high": np.float32([0.5] * 3), "dtype": np.dtype("f4")})()


def test_glitches_of_a_simulator_end_nothing_and_the_actions_taken_are_kept(tmp_path, data):
    run = learner(tmp_path / "run", data, listen=free_endpoint())
    with evaluators(run, 2, Narrow):
        log = run.folder / "experience.log"
        wait(lambda: log.exists() and log.stat().st_size > 10_000)
        run.process.kill()
        run.end()
        run = learner(run.folder, data, listen=run.endpoint)
        code, said = run.end()
    assert code == 0, said
    assert "training leaves out an online episode: array `observations`, row 2, column 3: 1e30, far outside the dataset's range" in said
    undisturbed = learner(tmp_path / "undisturbed", data)
    with evaluators(undisturbed, 1, Narrow):
        code, said = undisturbed.end()
    assert code == 0 and checkpoint(run.folder) == checkpoint(undisturbed.folder), said
    episodes = [np.frombuffer(rows, np.float32).reshape(-1, 11 + 3 + 1) for rows in experience(run.folder).values()]
    actions = np.concatenate(episodes)[:, 11:14]
    assert np.abs(actions).max() == 0.5 and np.isclose(np.abs(actions), 0.5).mean() > 0.2
    assert any(len(rows) == 1 for rows in episodes), "they end before NaN"
