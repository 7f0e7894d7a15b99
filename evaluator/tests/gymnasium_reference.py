"""Drives the real Gymnasium for sim/gymnasium.rs, which runs it and reads what it prints: one JSON object.

    gymnasium_reference.py model NAME MJCF   fields of the model in the file MJCF that are not those of Gymnasium's
    gymnasium_reference.py steps NAME        steps in Gymnasium from random states, one by one and in a row

NAME is one of the TASKS below. The margins of all geoms are halved: today's MuJoCo adds the two of a pair up, and took
the larger until 3.4.
"""

import json
import sys

import gymnasium
import mujoco
import numpy as np

# Looks, names and users' own data; nothing that moves depends on them.
LOOKS = ("cam_", "light_", "mat_", "tex_", "name_", "names", "paths", "geom_matid", "geom_rgba", "geom_user", "numeric_")
COUNTS = ("ncam", "nlight", "nmat", "ntex", "ntexdata", "nnames", "nnames_map", "npaths", "nuser_geom", "nnumeric", "nnumericdata")
MEMORY = ("signature", "nbuffer", "narena")
TOLERANCE = 1e-12


class Planar:
    """Hopper, HalfCheetah or Walker2d, -v4 or -v5.

    `spread` is how far the random positions are from the initial ones; the joints in `backwards` bend one way only. States are
    standing, crouching, falling, lying or in the air: often in contact, often beyond what is healthy.
    """

    def __init__(self, name, spread, backwards=()):
        self.environment = gymnasium.make(name).unwrapped
        self.model = self.environment.model
        self.frame_skip = self.environment.frame_skip
        halve_margins(self.model)
        self.spread, self.backwards = np.array(spread), list(backwards)

    def random_state(self, random):
        qpos = self.environment.init_qpos + random.uniform(-1, 1, self.spread.size) * self.spread
        qpos[self.backwards] = -np.abs(qpos[self.backwards])
        return qpos, random.normal(0, 1, self.spread.size) * random.choice([0.1, 2.0, 12.0])

    def set_state(self, qpos, qvel, _goal):
        mujoco.mj_resetData(self.model, self.environment.data)
        self.environment.set_state(qpos, qvel)

    def step(self, action):
        return self.environment.step(np.clip(action, -1, 1))[:3]


class AntMaze:
    """D4RL's AntMaze, put together from the body of Gymnasium's Ant-v4 and a drawing of the maze.

    D4RL's ant has twice the time step, other motors (gear 1 instead of 150, controls within ±30 instead of ±1) and softer contacts.
    """

    frame_skip = 5

    def __init__(self, maze):
        spec = mujoco.MjSpec.from_file(gymnasium.make("Ant-v4").unwrapped.fullpath)
        spec.option.timestep = 0.02
        for motor in spec.actuators:
            motor.gear[0] = 1
            motor.ctrlrange = [-30, 30]
        self.free = []
        for i, row in enumerate(maze.split()):
            for j, cell in enumerate(row):
                x, y = 4 * (j - 1), 4 * (i - 1)
                if cell == "1":
                    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[2, 2, 1], pos=[x, y, 1], conaffinity=1)
                else:
                    self.free.append((x, y))
        for geom in spec.geoms:
            geom.solimp[:3] = [0.8, 0.8, 0.01]
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        halve_margins(self.model)

    def random_state(self, random):
        """Anywhere in the maze and at its walls, on its feet or fallen over, slow or flung."""
        qpos = self.model.qpos0.copy()
        qpos[:2] = self.free[random.integers(len(self.free))] + random.uniform(-2.3, 2.3, 2)
        qpos[2] = random.uniform(0.3, 0.9)
        qpos[3:7] += random.choice([0.1, 1.0]) * random.normal(0, 1, 4)
        qpos[7:] = [0, 0.8, 0, -0.8, 0, -0.8, 0, 0.8] + random.uniform(-0.6, 0.6, 8)
        return qpos, random.normal(0, 1, 14) * random.choice([0.1, 1.0, 5.0])

    def set_state(self, qpos, qvel, goal):
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self.goal = np.array(goal)
        mujoco.mj_forward(self.model, self.data)

    def step(self, action):
        self.data.ctrl[:] = np.clip(30 * action, -30, 30)
        mujoco.mj_step(self.model, self.data, self.frame_skip)
        reached = np.linalg.norm(self.data.qpos[:2] - self.goal) <= 0.5
        return np.concatenate([self.data.qpos, self.data.qvel]), float(reached), reached


class OgBench:
    """A task of OGBench's AntMaze. Its states are random like D4RL's ant's."""

    frame_skip = 5
    random_state = AntMaze.random_state

    def __init__(self, name):
        import ogbench

        self.environment = gymnasium.make(name).unwrapped
        self.model = self.environment.model
        halve_margins(self.model)
        self.free = [self.environment.ij_to_xy(cell) for cell in np.argwhere(self.environment.maze_map == 0)]

    def set_state(self, qpos, qvel, goal):
        mujoco.mj_resetData(self.model, self.environment.data)
        self.environment.set_state(qpos, qvel)
        self.environment.set_goal(goal_xy=np.array(goal))

    def step(self, action):
        observation, reward, terminated = self.environment.step(action)[:3]
        return observation, reward + 1, terminated


class PointMaze(OgBench):
    """A task of OGBench's ball, which is often in a wall: an action puts it there."""

    def random_state(self, random):
        place = self.free[random.integers(len(self.free))] + random.uniform(-1.9, 1.9, 2)
        return place, random.normal(0, 1, 2)

    def step(self, action):
        return super().step(np.clip(action, -1, 1))


def halve_margins(model):
    model.geom_margin[:] *= 0.5
    model.body_margin[:] *= 0.5  # The largest of a body's geoms', for the broad phase.


TASKS = {
    "ant": lambda: Planar("Ant-v4", [0.1] * 15),
    "antmaze-umaze": lambda: AntMaze("11111 1R001 11101 1G001 11111"),
    "antmaze-medium": lambda: AntMaze("11111111 1R011001 10010001 11000111 10010001 10100101 100010G1 11111111"),
    "antmaze-large": lambda: AntMaze(
        "111111111111 1R0001000001 101101010101 100000010001 101111011101 100101000001 110101010111 100100010G01 111111111111"
    ),
}
for name, version in [("", "v4"), ("-v5", "v5")]:
    TASKS |= {
        f"hopper{name}": lambda version=version: Planar(f"Hopper-{version}", [2.0, 0.35, 0.3, 0.5, 0.5, 0.8], backwards=[3, 4]),
        f"halfcheetah{name}": lambda version=version: Planar(f"HalfCheetah-{version}", [2.0, 0.4, 2.0] + [0.8] * 6),
        f"walker2d{name}": lambda version=version: Planar(f"Walker2d-{version}", [2.0, 0.6, 1.2] + [0.8] * 6, backwards=[3, 4, 6, 7]),
    }
for place in ["medium", "large", "giant"]:
    TASKS[f"antmaze-{place}-singletask-v0"] = lambda place=place: OgBench(f"antmaze-{place}-singletask-v0")
    TASKS[f"pointmaze-{place}-singletask-v0"] = lambda place=place: PointMaze(f"pointmaze-{place}-singletask-v0")


def numbers(struct):
    """Name and flat float array of every numeric field of one of MuJoCo's structs."""
    for name in dir(struct):
        if name.startswith("_") or name in COUNTS + MEMORY or name.startswith(LOOKS):
            continue
        value = getattr(struct, name)
        if isinstance(value, (int, float, np.ndarray)):
            yield name, np.asarray(value, dtype=np.float64).ravel()


def compare_models(name, path):
    ours, theirs = mujoco.MjModel.from_xml_path(path), TASKS[name]().model
    compared, differ = 0, {}
    for part in ("", "opt", "stat"):
        mine = dict(numbers(getattr(ours, part) if part else ours))
        for field, expected in numbers(getattr(theirs, part) if part else theirs):
            compared += expected.size
            found = mine[field]
            if found.shape != expected.shape or not np.allclose(found, expected, rtol=TOLERANCE, atol=TOLERANCE):
                differ[f"{part}.{field}".strip(".")] = f"{found.tolist()}, but Gymnasium has {expected.tolist()}"
    return {"compared": compared, "differ": differ}


def record_steps(name, seed=0, states=1000, sequences=40, seconds=0.4):
    """`seconds` of simulated time is short enough for chaos not to make one rounding visible."""
    random = np.random.default_rng(seed)
    task = TASKS[name]()
    length = round(seconds / (task.model.opt.timestep * task.frame_skip))

    def sequence(steps):
        qpos, qvel = task.random_state(random)
        goal = (qpos[:2] + random.uniform(-1, 1, 2)).tolist()  # Near by: it is often reached. Ignored where there is none.
        task.set_state(qpos, qvel, goal)
        recorded = {"qpos": qpos.tolist(), "qvel": qvel.tolist(), "goal": goal, "steps": []}
        for _ in range(steps):
            # Beyond the bounds, too: D4RL clips before it steps. float32 is what a policy gives; as float64, so that the
            # control cost is computed in it.
            action = random.uniform(-1.3, 1.3, task.model.nu).astype(np.float32).astype(np.float64)
            observation, reward, terminated = task.step(action)
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
