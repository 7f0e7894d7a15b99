"""The other side of this crate's tests: h5py and NumPy, with D4RL's rules written a second time, as plain loops.

    peers.py generate VARIANT OUT    a small Hopper-sized file, with episodes of every kind
    peers.py reference FILE OUT      its transitions, as an HDF5 file of flat float32 arrays
    peers.py check-written FILE N    asserts that FILE is what the writer's test wrote, N rows
"""

import sys

import h5py
import numpy as np

LIMIT = 1000


def generate(variant, out):
    rng = np.random.default_rng(7)
    # (length, terminal at its end, timeout at its end); the last episode is cut off by the end of the file.
    episodes = [(5, True, False), (8, False, True), (4, True, True), (1, True, False), (1, False, True), (6, False, False)]
    if variant == "no-timeouts":
        episodes = [(LIMIT, False, False), (3, True, False), (LIMIT, True, False), (LIMIT + 5, False, False)]
    n = sum(length for length, _, _ in episodes)
    terminals, timeouts = np.zeros(n, bool), np.zeros(n, bool)
    end = -1
    for length, terminal, timeout in episodes:
        end += length
        terminals[end], timeouts[end] = terminal, timeout
    observations = rng.normal(size=(n, 11))
    # A dropped timeout row whose successor starts where it would have led: one trajectory goes on through it.
    if variant != "no-timeouts":
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
        if variant == "no-timeouts":
            del column["timeouts"]
        for name, values in column.items():
            file.create_dataset(name, data=values, compression="gzip", compression_opts=4)
        file["observations"] = observations.astype(dtype)
        file["actions"] = actions.astype(dtype)


def reference(path, out):
    with h5py.File(path, "r") as file:
        observations = file["observations"][()].astype(np.float32)
        actions = file["actions"][()].astype(np.float32)
        rewards = file["rewards"][()].reshape(-1).astype(np.float32)
        terminals = file["terminals"][()].reshape(-1).astype(bool)
        if "timeouts" in file:
            timeouts = file["timeouts"][()].reshape(-1).astype(bool)
        else:
            timeouts = np.zeros(len(rewards), bool)
            start = 0
            for i in range(len(rewards)):
                timeouts[i] = i - start + 1 == LIMIT
                if terminals[i] or timeouts[i]:
                    start = i + 1

    kept = [i for i in range(len(rewards) - 1) if not timeouts[i]]
    s, s_next = observations[kept], observations[[i + 1 for i in kept]]
    a = np.clip(actions[kept], np.float32(-1 + 1e-5), np.float32(1 - 1e-5))
    r, done = rewards[kept].astype(np.float64), terminals[kept]

    returns, total = [], 0.0
    for k in range(len(kept)):
        total += r[k]
        if k == len(kept) - 1 or done[k] or np.linalg.norm(s[k + 1] - s_next[k]) > 1e-6:
            returns.append(total)
            total = 0.0
    scaled = r * 1000 / (max(returns) - min(returns))

    episodes = np.split(rewards.astype(np.float64), np.flatnonzero(terminals | timeouts) + 1)
    episode_returns = np.array([episode.sum() for episode in episodes if len(episode)])
    arrays = {
        "observations": s,
        "actions": a,
        "rewards": scaled,
        "next_observations": s_next,
        "masks": 1 - done,
        "raw_rewards": r,
    }
    with h5py.File(out, "w") as file:
        for name, values in arrays.items():
            file[name] = np.asarray(values, np.float32).reshape(-1)
        figures = [len(kept), len(episode_returns), episode_returns.mean(), episode_returns.min(), episode_returns.max()]
        file["statistics"] = np.array(figures, np.float64)


def check_written(path, n):
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
        assert metadata == {"algorithm": b"formula", "environment": b"hopper", "iteration": 12, "seed": 34}, metadata


if __name__ == "__main__":
    command, *arguments = sys.argv[1:]
    if command == "check-written":
        check_written(arguments[0], int(arguments[1]))
    else:
        {"generate": generate, "reference": reference}[command](*arguments)
