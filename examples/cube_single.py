"""Records OGBench's `cube-single-play-v0` anew, in its own environment by its own scripted arm, as its files are.

python examples/cube_single.py FOLDER [EPISODES]      writes FOLDER/cube-single-play-v0.npz and …-val.npz
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
from ogbench.manipspace.oracles.plan.cube_plan import CubePlanOracle

ROWS = 1001  # of a trajectory: a thousand steps, and the state after them


def record(env, arm, episodes):
    columns = {name: [] for name in ("observations", "actions", "terminals", "qpos", "qvel")}
    for _ in range(episodes):
        seen, info = env.reset()
        arm.reset(seen, info)
        for row in range(ROWS):
            action = np.clip(arm.select_action(seen, info), -1, 1)
            after, _, _, _, info = env.step(action)
            values = (seen, action, row == ROWS - 1, info["prev_qpos"], info["prev_qvel"])
            for column, value in zip(columns.values(), values):
                column.append(value)
            if arm.done:  # It has put the cube down: to another place.
                after, info = env.unwrapped.set_new_target()
                arm.reset(after, info)
            seen = after
    return {name: np.array(rows, bool if name == "terminals" else np.float32) for name, rows in columns.items()}


folder, episodes = Path(sys.argv[1]), int(sys.argv[2]) if sys.argv[2:] else 100
env = gymnasium.make("ogbench:cube-single-v0", terminate_at_goal=False, mode="data_collection", max_episode_steps=ROWS)
np.random.seed(0)  # The arm draws from NumPy's own generator.
env.reset(seed=0)
arm = CubePlanOracle(env=env, noise=0.1, noise_smoothing=0.5)
folder.mkdir(parents=True, exist_ok=True)
for part, count in {"": episodes, "-val": max(1, episodes // 10)}.items():
    np.savez_compressed(folder / f"cube-single-play-v0{part}.npz", **record(env, arm, count))
