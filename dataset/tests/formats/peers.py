"""The other side of this crate's tests: D4RL's rules written a second time, as plain loops in NumPy, and the readers of
Minari and OGBench. Each command is a function below, its underscores written as dashes.

A reference file has the transitions as flat float32 arrays, and `statistics`: how many there are, the number of episodes,
and the mean, smallest and largest return.
"""

import sys

import h5py
import numpy as np

LIMIT = 1000


def generate(variant, out):
    """A small Hopper-sized file in D4RL's layout, with episodes of every kind."""
    rng = np.random.default_rng(7)
    # (length, terminal at its end, timeout at its end); the last episode is cut off by the end of the file.
    episodes = [(5, True, False), (8, False, True), (4, True, True), (1, True, False), (1, False, True), (6, False, False)]
    if variant == "v0":
        episodes = [(LIMIT, False, False), (3, True, False), (LIMIT, True, False), (LIMIT + 5, False, False)]
    if variant in ("v1", "shuffled"):
        episodes = [(300, True, False), (200, False, True), (100, False, False)]
    n = sum(length for length, _, _ in episodes)
    terminals, timeouts = np.zeros(n, bool), np.zeros(n, bool)
    end = -1
    for length, terminal, timeout in episodes:
        end += length
        terminals[end], timeouts[end] = terminal, timeout
    observations = rng.normal(size=(n, 11))
    # A dropped timeout row whose successor starts where it would have led: one trajectory goes on through it.
    if variant not in ("v0", "v1", "shuffled"):
        observations[13] = observations[12]
    actions = np.clip(rng.normal(size=(n, 3)), -1, 1)
    rewards = rng.normal(size=n)
    dtype = np.float64 if variant == "float64" else np.float32
    with h5py.File(out, "w") as file:
        column = {"rewards": rewards.astype(dtype), "terminals": terminals, "timeouts": timeouts}
        if variant == "columns":
            column = {name: values[:, None] for name, values in column.items()}
        if variant == "integers":
            column["terminals"] = column["terminals"].astype(np.uint8)
            column["timeouts"] = column["timeouts"].astype(np.int8)
        if variant == "v0":
            del column["timeouts"]
        for name, values in column.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
        file["observations"] = observations.astype(dtype)
        file["actions"] = actions.astype(dtype)
        if variant in ("v1", "shuffled"):
            # Of a replay buffer, a row inside an episode may lead elsewhere; of shuffled rows, nearly all do.
            following = np.roll(observations, -1, axis=0)
            elsewhere = slice(0, n) if variant == "shuffled" else slice(100, 101)
            following[elsewhere] = rng.normal(size=following[elsewhere].shape)
            file["next_observations"] = following.astype(dtype)
            file["infos/qpos"], file["infos/qvel"] = np.zeros((n, 6)), np.zeros((n, 6))


def generate_antmaze(out):
    """Episodes of 700 steps that go on after the goal, which is where reward and terminal are 1, in AntMaze's layout."""
    rng = np.random.default_rng(8)
    # Rows within the goal; the third episode never reaches it, the fourth does at its last step, the fifth is cut off.
    at_goal = [range(200, 260), [*range(650, 700)], [], [699], range(10, 11)]
    n = 4 * 700 + 100
    terminals, timeouts = np.zeros(n, bool), np.zeros(n, bool)
    timeouts[699::700] = True
    for episode, rows in enumerate(at_goal):
        terminals[[episode * 700 + row for row in rows]] = True
    with h5py.File(out, "w") as file:
        file["observations"] = rng.normal(size=(n, 29)).astype(np.float32)
        file["actions"] = rng.uniform(-1, 1, size=(n, 8)).astype(np.float32)
        file["rewards"], file["terminals"], file["timeouts"] = terminals.astype(np.float32), terminals, timeouts
        file["infos/goal"] = np.zeros((n, 2), np.float32)


def reference(path, limit, goal, out):
    """The transitions of a file in D4RL's layout. `limit` makes timeouts where the file has none, `goal` is 1 for AntMaze."""
    limit, goal = int(limit), goal == "1"
    with h5py.File(path, "r") as file:
        observations = file["observations"][()].astype(np.float32)
        actions = file["actions"][()].astype(np.float32)
        rewards = file["rewards"][()].reshape(-1).astype(np.float32)
        terminals = file["terminals"][()].reshape(-1).astype(bool)
        if "timeouts" in file:
            timeouts = file["timeouts"][()].reshape(-1).astype(bool)
        else:
            timeouts = np.zeros(len(rewards), bool)
            episode_step = 0
            for i in range(len(rewards)):
                timeouts[i] = episode_step == limit - 1
                if timeouts[i]:
                    episode_step = 0
                    continue
                if terminals[i]:
                    episode_step = 0
                episode_step += 1

    kept = [i for i in range(len(rewards) - 1) if not timeouts[i]]
    s, s_next = observations[kept], observations[[i + 1 for i in kept]]
    r, done = rewards[kept].astype(np.float64), terminals[kept]
    trajectories, start = [], 0
    for k in range(len(kept)):
        if k == len(kept) - 1 or done[k] or np.linalg.norm(s[k + 1] - s_next[k]) > 1e-6:
            trajectories.append(range(start, k + 1))
            start = k + 1

    ends = timeouts if goal else terminals | timeouts
    episodes = [part for part in np.split(rewards.astype(np.float64), np.flatnonzero(ends) + 1) if len(part)]
    if goal:
        episodes = [part[: np.argmax(part > 0) + 1] if part.max() > 0 else part for part in episodes]
    write_reference(out, s, actions[kept], r, s_next, done, trajectories, [part.sum() for part in episodes])


def write_reference(out, s, a, r, s_next, done, trajectories, returns):
    """`trajectories` are rows of each, between whose returns the locomotion rule spreads 1000."""
    r = np.asarray(r, np.float32).astype(np.float64)
    sums = [sum(r[k] for k in rows) for rows in trajectories]
    returns = np.array(returns)
    arrays = {
        "observations": s,
        "actions": np.clip(np.asarray(a, np.float32), np.float32(-1 + 1e-5), np.float32(1 - 1e-5)),
        "rewards": r * 1000 / (max(sums) - min(sums)),
        "next_observations": s_next,
        "masks": 1 - np.asarray(done, np.float32),
        "raw_rewards": r,
    }
    with h5py.File(out, "w") as file:
        for name, values in arrays.items():
            file[name] = np.asarray(values, np.float32).reshape(-1)
        figures = [len(s), len(returns), returns.mean(), returns.min(), returns.max()]
        file["statistics"] = np.array(figures, np.float64)


# Of each dataset that Minari writes: the environment's id, and the parts of an observation in the order of a row.
ROBOTS = {
    "hopper": ("Hopper-v5", None),
    "walker2d": ("Walker2d-v5", None),
    "antmaze": ("AntMaze_UMaze-v4", ["achieved_goal", "desired_goal", "observation"]),
    "own": ("Robot-v0", ["place", "speed"]),
    "tuple": ("Robot-v0", range(12)),
    "nested": ("FrankaKitchen-v1", None),
    "discrete": ("CartPole-v1", None),
}


def make_robot(kind):
    """An environment of which Minari asks only for the spaces."""
    import gymnasium
    from gymnasium.spaces import Box, Dict, Discrete, Tuple

    box = lambda n: Box(-np.inf, np.inf, (n,), np.float64)
    goals = {"achieved_goal": box(2), "desired_goal": box(2)}
    robot = gymnasium.Env()
    robot.observation_space = {
        "hopper": box(11),
        "walker2d": box(17),
        "antmaze": Dict(goals | {"observation": box(27)}),
        "own": Dict({"speed": box(1), "place": box(3)}),
        "tuple": Tuple([box(1) for _ in range(12)]),
        "nested": Dict({"achieved_goal": Dict({"kettle": box(7)}), "observation": box(59)}),
        "discrete": box(4),
    }[kind]
    robot.action_space = Box(-1, 1, ({"hopper": 3, "walker2d": 6, "antmaze": 8}.get(kind, 2),), np.float32)
    if kind == "discrete":
        robot.action_space = Discrete(2)
    return robot


def write_minari(kind, id):
    """A dataset of a few episodes of one of the `ROBOTS`, written by Minari itself."""
    import minari
    from gymnasium.envs.registration import EnvSpec
    from minari.data_collector import EpisodeBuffer

    rng = np.random.default_rng(9)
    robot = make_robot(kind)
    episodes = []
    for length, terminal in [(5, True), (9, False), (1, True), (7, False)]:

        def draw(space):
            if hasattr(space, "items"):
                return {key: draw(part) for key, part in space.items()}
            if hasattr(space, "spaces"):
                return tuple(draw(part) for part in space.spaces)
            return rng.normal(size=(length + 1, *space.shape)).astype(space.dtype)

        last = np.arange(length) == length - 1
        actions = rng.uniform(-1, 1, size=(length, *robot.action_space.shape)).astype(np.float32)
        episodes.append(EpisodeBuffer(
            observations=draw(robot.observation_space),
            actions=(actions > 0).astype(np.int64) if kind == "discrete" else actions,
            rewards=list(rng.normal(size=length)),
            terminations=list(last & terminal),
            truncations=list(last & (not terminal)),
        ))
    spec = EnvSpec(id=ROBOTS[kind][0], entry_point="peers:make_robot", kwargs={"kind": kind}, max_episode_steps=1000)
    minari.create_dataset_from_buffers(
        id,
        buffer=episodes,
        env=spec,
        algorithm_name="noise",
        author="a test",
        author_email="test@example.org",
        code_permalink="none",
        data_format="hdf5",
    )


def minari_reference(kind, id, out):
    """The transitions that Minari reads."""
    import minari

    _, keys = ROBOTS[kind]
    columns, trajectories, returns = [[], [], [], [], []], [], []
    for episode in minari.load_dataset(id).iterate_episodes():
        seen = episode.observations
        seen = np.concatenate([seen[key] for key in keys], axis=1) if keys else seen
        first = sum(map(len, columns[0]))
        for column, values in zip(columns, [seen[:-1], episode.actions, episode.rewards, seen[1:], episode.terminations]):
            column.append(values)
        rewards = episode.rewards.astype(np.float32).astype(np.float64)
        trajectories.append(range(first, first + len(rewards)))
        returns.append(rewards.sum())
    write_reference(out, *map(np.concatenate, columns), trajectories, returns)


def write_ogbench(variant, out):
    """Trajectories whose last state is a row of its own, with masks and rewards; or what OGBench's loader makes of them."""
    import ogbench.utils

    rng = np.random.default_rng(10)
    lengths = [6, 9, 1, 4]  # steps
    n = sum(lengths) + len(lengths)
    terminals = np.zeros(n, bool)
    terminals[np.cumsum(np.array(lengths) + 1) - 1] = True
    arrays = {
        "observations": rng.normal(size=(n, 11)).astype(np.float32),
        "actions": rng.uniform(-1, 1, size=(n, 3)).astype(np.float32),
        "terminals": terminals,
        "rewards": rng.normal(size=n).astype(np.float64),
        "masks": (rng.random(n) < 0.8).astype(np.float32),
    }
    if variant == "goals":
        del arrays["rewards"], arrays["masks"]
    if variant == "maze":
        arrays["observations"], arrays["actions"] = np.zeros((n, 29), np.float32), np.zeros((n, 8), np.float32)
    if variant == "discrete":
        arrays["actions"] = rng.integers(0, 2, size=(n, 1))
    if variant == "fortran":
        arrays["observations"] = np.asfortranarray(arrays["observations"])
    np.savez_compressed(out, **arrays)
    if variant in ("regular", "compact"):
        loaded = ogbench.utils.load_dataset(out, compact_dataset=variant == "compact")
        steps = np.ones(n, bool) if variant == "compact" else ~terminals
        np.savez(out, **loaded, rewards=arrays["rewards"][steps], masks=arrays["masks"][steps])


def ogbench_reference(path, out):
    """The transitions that OGBench reads from a file whose last states are rows of their own."""
    import ogbench.utils

    file = np.load(path)
    steps = ~file["terminals"].astype(bool)
    data = ogbench.utils.load_dataset(path)
    done = file["masks"][steps] == 0
    ends = np.flatnonzero(data["terminals"]) + 1
    rewards = file["rewards"][steps]
    cuts = np.flatnonzero((data["terminals"] > 0) | done) + 1
    trajectories = [rows for rows in np.split(np.arange(len(rewards)), cuts) if len(rows)]
    episodes = np.split(rewards.astype(np.float32).astype(np.float64), ends)
    returns = [part.sum() for part in episodes if len(part)]
    write_reference(
        out, data["observations"], data["actions"], rewards, data["next_observations"], done, trajectories, returns
    )


def ogbench_mazes(folder):
    """A file for each of OGBench's mazes, with places around all goals, and for each of its tasks what OGBench makes of them."""
    import gymnasium
    import ogbench.relabel_utils

    rng = np.random.default_rng(11)
    places = [f"{robot}maze-{size}" for robot in ("point", "ant", "humanoid") for size in ("medium", "large", "giant")]
    for place in [*places, "antsoccer-arena", "antsoccer-medium"]:
        env = gymnasium.make(f"{place}-singletask-v0").unwrapped
        goals = np.array([task["goal_xy"] for task in env.task_infos])
        xy = np.repeat(goals, 60, axis=0) + env._goal_tol * rng.uniform(-1.6, 1.6, (300, 2))
        column = 15 if "soccer" in place else 0
        arrays = {"qpos": rng.normal(size=(300, 30)).astype(np.float32)}
        arrays["observations"] = np.zeros((300, env.observation_space.shape[0]), np.float32)
        for array in arrays.values():
            array[:, column : column + 2] = xy
        terminals = np.arange(300) % 50 == 49
        actions = np.zeros((300, env.action_space.shape[0]), np.float32)
        np.savez(f"{folder}/{place}.npz", **arrays, actions=actions, terminals=terminals)
        default = env._reward_task_id
        for ending, task in [("", default), *((f"-task{task}", task) for task in range(1, 6))]:
            env._reward_task_id, name = task, f"{place}-singletask{ending}-v0"
            data = dict(arrays)
            ogbench.relabel_utils.relabel_dataset(name, env, data)
            with h5py.File(f"{folder}/{name}.hdf5", "w") as file:
                file["rewards"], file["masks"] = data["rewards"][~terminals], data["masks"][~terminals]
                info = env.task_infos[task - 1]
                file["start"] = np.array(info["agent_init_xy" if "soccer" in place else "init_xy"])


def write_log(out):
    """A user's log: 12 steps of a robot in episodes of 4 (it fell), 6 (stopped) and 2 (still going) steps."""
    i = np.arange(12)
    state = 10.0 * i[:, None] + np.arange(5)
    action = np.tile([0.5, -0.5], (12, 1))
    np.savez(out, state=state, action=action, reward=i, next_state=state + 5, done=i == 3, timeout=i == 9)


def run(script):
    """Runs another script."""
    exec(compile(open(script).read(), script, "exec"), {})


# The attribute `layout` as h5py writes a str, and as NumPy's bytes, C, C++, Julia and MATLAB have it.
LAYOUTS = {
    "text": "transitions",
    "bytes": np.bytes_("transitions"),
    "padded": np.array("transitions", h5py.string_dtype("ascii", 40)),
    "utf-8": np.array("transitions", h5py.string_dtype("utf-8", 11)),
    "variable-ascii": np.array("transitions", h5py.string_dtype("ascii")),
    "one-element": np.array(["transitions"], h5py.string_dtype("ascii", 11)),
    "unknown": "transition",
    "number": 3,
}


def write_own(out, layout="text", action="float32"):
    """Three episodes of three rows in the custom layout, without timeouts and without terminals."""
    steps = np.arange(9) + 10.0 * (np.arange(9) // 3)
    with h5py.File(out, "w") as file:
        file.attrs["layout"] = LAYOUTS[layout]
        file["observations"] = np.stack([steps, -steps], axis=1)
        file["next_observations"] = np.stack([steps + 1, -steps - 1], axis=1)
        file["actions"] = np.zeros((9, 1), action)
        file["rewards"] = np.ones(9, np.int64)
        file["terminals"] = np.zeros(9, np.float32)


def check_written(path, n):
    """Asserts that the file is what the writer's test wrote, of n rows."""
    n = int(n)
    i, j = np.arange(n, dtype=np.float32)[:, None], np.arange(11, dtype=np.float32)[None, :]
    expected = {
        "observations": i + j / 16,
        "actions": ((i * 3 + j[:, :3]) % 7 - 3) / 4,
        "next_observations": i + 1 + j / 16,
        "rewards": i[:, 0] / 8,
        "terminals": i[:, 0] % 50 == 49,
        "timeouts": i[:, 0] % 70 == 69,
        "infos/qpos": -i - j[:, :6] / 16,
        "infos/qvel": j[:, :6] - i / 32,
    }
    with h5py.File(path, "r") as file:
        assert sorted(file) == sorted(["infos", "metadata"] + [name for name in expected if "/" not in name]), list(file)
        for name, values in expected.items():
            array = file[name]
            assert array.shape == values.shape and array.dtype == values.dtype, (name, array)
            assert array.compression == "gzip" and array.compression_opts == 4 and array.chunks, name
            assert np.array_equal(array[()], values), name
        for name in "terminals", "timeouts":
            ours = file[name].id.get_type()
            members = {ours.get_member_name(k): ours.get_member_value(k) for k in range(ours.get_nmembers())}
            assert members == {b"FALSE": 0, b"TRUE": 1} and ours.get_super() == h5py.h5t.STD_I8LE, (name, members)
        metadata = {name: value[()] for name, value in file["metadata"].items()}
        assert metadata == {"algorithm": b"formula", "environment": b"hopper", "iteration": 12, "run": b"mine", "seed": 34, "weights": b"0f"}, metadata


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    globals()[command.replace("-", "_")](*arguments)
