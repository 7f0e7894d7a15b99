"""Drives the real Gymnasium for tests/gymnasium.rs, which runs it and reads what it prints: one JSON object.

    gymnasium_reference.py model MJCF   fields of the model in the file MJCF that are not those of Hopper-v4's
    gymnasium_reference.py steps        steps of Hopper-v4 from random states, one by one and in a row

The margins of Hopper-v4's geoms are halved: today's MuJoCo adds the two of a pair up, and took the larger until 3.4.
"""

import json
import sys

import gymnasium
import mujoco
import numpy as np

# Looks and names; nothing that moves depends on them.
LOOKS = ("cam_", "light_", "mat_", "tex_", "name_", "names", "paths", "geom_matid", "geom_rgba")
NOT_COMPARED = ("signature", "ncam", "nlight", "nmat", "ntex", "ntexdata", "nnames", "nnames_map", "npaths", "nbuffer")
TOLERANCE = 1e-12


def hopper():
    environment = gymnasium.make("Hopper-v4").unwrapped
    environment.model.geom_margin[:] *= 0.5
    environment.model.body_margin[:] *= 0.5  # The largest of a body's geoms', for the broad phase.
    return environment


def numbers(struct):
    """Name and flat float array of every numeric field of one of MuJoCo's structs."""
    for name in dir(struct):
        if name.startswith("_") or name in NOT_COMPARED or name.startswith(LOOKS):
            continue
        value = getattr(struct, name)
        if isinstance(value, (int, float, np.ndarray)):
            yield name, np.asarray(value, dtype=np.float64).ravel()


def compare_models(path):
    ours, theirs = mujoco.MjModel.from_xml_path(path), hopper().model
    compared, differ = 0, []
    for part in ("", "opt", "stat"):
        mine = dict(numbers(getattr(ours, part) if part else ours))
        for name, expected in numbers(getattr(theirs, part) if part else theirs):
            compared += expected.size
            found = mine[name]
            if found.shape != expected.shape or not np.all(np.abs(found - expected) <= TOLERANCE):
                differ.append(f"{part}.{name}: {found.tolist()}, but Gymnasium has {expected.tolist()}")
    return {"compared": compared, "differ": differ}


def random_state(random, environment):
    """Standing, crouching, falling, lying or in the air: often in contact, often beyond what is healthy."""
    qpos = environment.init_qpos + random.uniform(-1, 1, 6) * [2.0, 0.35, 0.3, 0.5, 0.5, 0.8]
    qpos[3:5] = -np.abs(qpos[3:5])
    return qpos, random.normal(0, 1, 6) * random.choice([0.1, 2.0, 12.0])


def record_steps(seed=0, states=1000, sequences=40, length=50):
    random = np.random.default_rng(seed)
    environment = hopper()

    def sequence(steps):
        qpos, qvel = random_state(random, environment)
        mujoco.mj_resetData(environment.model, environment.data)
        environment.set_state(qpos, qvel)
        recorded = {"qpos": qpos.tolist(), "qvel": qvel.tolist(), "steps": []}
        for _ in range(steps):
            # Beyond the bounds, too: D4RL clips before it steps. float32 is what a policy gives; as float64, so that the
            # control cost is computed in it.
            action = random.uniform(-1.3, 1.3, 3).astype(np.float32).astype(np.float64)
            observation, reward, terminated, _, _ = environment.step(np.clip(action, -1, 1))
            recorded["steps"].append(
                {
                    "action": action.tolist(),
                    "observation": observation.tolist(),
                    "reward": float(reward),
                    "terminated": bool(terminated),
                }
            )
        return recorded

    return {"sequences": [sequence(1) for _ in range(states)] + [sequence(length) for _ in range(sequences)]}


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    result = {"model": compare_models, "steps": record_steps}[command](*arguments)
    json.dump(result, sys.stdout)
