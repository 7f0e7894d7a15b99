"""Writes folders as LeRobot does, v3.0 and v2.1, of episodes that are given."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

FLAGS = ("next.success", "next.done", "next.terminated", "next.truncated")


def episodes(count=6, seed=0, simulated=False):
    """A list of dictionaries: state in degrees, action, and what a simulator adds. Even ones succeed, the others are cut off."""
    rng, made = np.random.default_rng(seed), []
    for i in range(count):
        steps = 5 + i
        one = {"observation.state": rng.normal(30, 20, (steps, 3)), "action": rng.uniform(-100, 100, (steps, 2)), "task": "pick"}
        if simulated:
            end = np.arange(steps) == steps - 1
            one |= {"next.reward": rng.normal(size=steps), "next.success": end & (i % 2 == 0), "next.done": end}
        made.append(one)
    return made


def write(root, episodes, version="v3.0", per_file=2, row_group=7, shuffle=None, lengths=None, files=None):
    """per_file: episodes a file. shuffle: a generator that orders the rows of each file. files: how each is written."""
    features = {
        "observation.state": {"dtype": "float32", "shape": [3], "names": {"motors": ["pan", "lift", "roll"]}},
        "action": {"dtype": "float32", "shape": [2], "names": ["pan", "lift"]},
        "observation.images.top": {"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]},
        **{name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in
           {"next.reward": "float32", **dict.fromkeys(FLAGS, "bool")}.items() if name in episodes[0]},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{name: {"dtype": "int64", "shape": [1], "names": None} for name in ("frame_index", "episode_index", "index", "task_index")},
    }
    tasks = sorted({task for one in episodes for task in np.atleast_1d(one["task"]).tolist()})
    info = {"codebase_version": version, "fps": 30, "total_episodes": len(episodes), "features": features,
            "total_frames": sum(len(one["action"]) for one in episodes)}
    (root / "meta").mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    tables, start = [], 0
    for number, one in enumerate(episodes):
        steps = len(one["action"])
        columns = {name: pa.array(list(np.asarray(one[name], np.float32)), pa.list_(pa.float32(), 3 if "state" in name else 2))
                   for name in ("observation.state", "action")}
        columns |= {name: pa.array(one[name]) for name in ("next.reward", *FLAGS) if name in one}
        columns |= {"timestamp": pa.array(np.arange(steps, dtype=np.float32) / 30), "frame_index": pa.array(np.arange(steps)),
                    "episode_index": pa.array(np.full(steps, number)), "index": pa.array(np.arange(start, start + steps)),
                    "task_index": pa.array([tasks.index(task) for task in np.broadcast_to(one["task"], steps)])}
        tables.append(pa.table(columns))
        start += steps
    rows = [{"episode_index": i, "tasks": np.unique(one["task"]).tolist(), "length": (lengths or {}).get(i, len(one["action"])),
             "is_success": i in (0, 3)}
            for i, one in enumerate(episodes)]
    if version == "v3.0":
        groups = [tables[i : i + per_file] for i in range(0, len(tables), per_file)]
        names = [f"data/chunk-{i // 2:03d}/file-{i % 2:03d}.parquet" for i in range(len(groups))]
        (root / "meta/episodes/chunk-000").mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(rows), root / "meta/episodes/chunk-000/file-000.parquet")
        table = pa.table({"task_index": list(range(len(tasks))), "__index_level_0__": tasks})
        pq.write_table(table, root / "meta/tasks.parquet")
    else:
        groups = [[table] for table in tables]
        names = [f"data/chunk-{i // 4:03d}/episode_{i:06d}.parquet" for i in range(len(groups))]
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        lines = (json.dumps({"task_index": i, "task": task}) + "\n" for i, task in enumerate(tasks))
        (root / "meta/tasks.jsonl").write_text("".join(lines))
    for name, group in zip(names, groups):
        table = pa.concat_tables(group)
        if shuffle is not None:
            table = table.take(shuffle.permutation(len(table)))
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, root / name, row_group_size=row_group)
    return root


def steps(episodes, number):
    """The transitions of one episode by hand: all steps but the last, and the last as well if it is a success."""
    one = episodes[number]
    state = np.asarray(one["observation.state"], np.float32)
    return state[:-1], state[1:], np.asarray(one["action"], np.float32)[:-1]
