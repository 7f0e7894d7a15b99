"""Gymnasium's step of each environment, timed: what `cargo bench -p quad-evaluator --bench rollout environment` is set beside.

    gymnasium_step.py [--seconds S]

Actions uniform at random, a new episode where one ends, as in the benchmark. Gymnasium has no AntMaze: its Ant-v4, which has
another time step and no walls, and D4RL's task as the tests put it together from Ant-v4's body, without any wrapper.
Prints a line of JSON: microseconds of CPU time per step, as medians; what else runs on the machine hardly counts.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import gymnasium
import numpy as np
from gymnasium_reference import TASKS

BATCH = 100


class Bare:
    """A test's AntMaze, with what the timing needs of Gymnasium's interface."""

    def __init__(self, name):
        self.task, self.random = TASKS[name](), np.random.default_rng(0)

    def reset(self):
        velocities = 0.1 * self.random.normal(0, 1, self.task.model.nv)
        self.task.set_state(self.task.model.qpos0 + self.random.uniform(-0.1, 0.1, self.task.model.nq), velocities, (0, 8))
        self.steps = 0

    def step(self, action):
        self.steps += 1
        observation, reward, terminated = self.task.step(action)
        return observation, reward, terminated, self.steps >= 1000, {}


def microseconds(environment, size, seconds):
    random, times = np.random.default_rng(0), []
    environment.reset()
    end = time.process_time() + seconds
    while time.process_time() < end:
        actions = random.uniform(-1, 1, (BATCH, size))
        start = time.process_time()
        for action in actions:
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()
        times.append((time.process_time() - start) / BATCH)
    return 1e6 * statistics.median(times)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=3.0)
    seconds = parser.parse_args().seconds
    result = {}
    for name in ["Hopper-v4", "HalfCheetah-v4", "Walker2d-v4", "Ant-v4"]:
        environment = gymnasium.make(name)
        result[name] = microseconds(environment, environment.action_space.shape[0], seconds)
    for name in ["antmaze-umaze", "antmaze-medium", "antmaze-large"]:
        result[name] = microseconds(Bare(name), 8, seconds)
    print(json.dumps(result))
