"""An episode of an evaluator in Python depends on its seed and its policy alone."""

import importlib

import gymnasium
import numpy as np
import pytest

import quad_rl
from quad_rl import _worker
from test_evaluate import Learner

EPISODES = 16
# Each with the sizes of its flat observation and of its action. Gymnasium's draws from its own generator, OGBench's from
# NumPy's global one (also in steps: its maze has teleporters) and from the action space.
ENVIRONMENTS = {
    "gymnasium": ("Hopper-v5", 11, 3),
    "gymnasium_robotics": ("PointMaze_UMaze-v3", 8, 2),
    "ogbench": ("pointmaze-teleport-v0", 2, 2),
}


class Traced(gymnasium.Wrapper):
    """Returns a sum over the whole path, to which every step contributes."""

    def step(self, action):
        observation, _, *rest = self.env.step(action)
        numbers = gymnasium.spaces.flatten(self.env.observation_space, observation)
        return observation, float(np.linalg.norm(numbers)), *rest


def make(package, name):
    def made(seed):
        gymnasium.register_envs(importlib.import_module(package))
        return Traced(gymnasium.make(name, max_episode_steps=60))

    return made


@pytest.mark.parametrize("package", ENVIRONMENTS)
def test_scores_do_not_depend_on_the_number_of_workers(package, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    name, observation, action = ENVIRONMENTS[package]
    rng, rows = np.random.default_rng(0), 400
    dataset = quad_rl.Dataset.from_arrays(
        observations=rng.normal(0.0, 5.0, (rows, observation)), actions=rng.uniform(-1, 1, (rows, action)),
        rewards=rng.normal(size=rows), terminations=np.zeros(rows, bool), truncations=np.arange(rows) % 100 == 99,
    )
    dataset.save(tmp_path / "data.hdf5")
    scores = {}
    for workers in (1, 4):
        folder, data = tmp_path / str(workers), tmp_path / "data.hdf5"
        learner = Learner(folder, data, environment="there", steps=20, episodes=EPISODES)
        with quad_rl.Evaluators("there", make(package, name), connect=learner.endpoint, workers=workers):
            code, said = learner.end()
        assert code == 0, said
        scores[workers] = {score["seed"]: score["score"] for score in learner.scores()}
    assert len(set(scores[1].values())) == EPISODES
    assert scores[1] == scores[4]


class Draws(gymnasium.Env):
    """Draws like OGBench from NumPy's global generator and from the action space, also in steps."""

    def __init__(self):
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
        self.mass = np.random.uniform()

    def reset(self, seed=None, options=None):
        return self.action_space.sample() + np.random.uniform(size=2), {}

    def step(self, action):
        drawn = self.action_space.sample() + np.random.randint(1000)
        return drawn, self.mass, False, False, {}


def test_concurrent_episodes_draw_like_single_ones():
    def by_hand(seed):
        np.random.seed(9)
        environment = Draws()
        np.random.seed(seed)
        environment.action_space.seed(seed)
        rows = [environment.reset()[0]]
        for _ in range(5):
            observation, mass, *_ = environment.step(None)
            rows += [observation, [mass, mass]]
        return np.array(rows)

    factory, action = _worker.Factory(lambda seed: gymnasium.wrappers.ClipAction(Draws()), "return", pytest.fail), np.zeros(2)
    for seeds in ([0, 1, 2], [2, 7], [1]):  # Environments serve again.
        made = [factory.make(9) for _ in seeds]
        rows = [[one.reset(seed)] for one, seed in zip(made, seeds)]
        for _ in range(5):
            for one, row in zip(made, rows):
                observation, mass, *_ = one.step(action)
                row += [observation, [mass, mass]]
        for one, seed, row in zip(made, seeds, rows):
            np.testing.assert_array_equal(np.array(row), by_hand(seed))
            factory.release(one)
