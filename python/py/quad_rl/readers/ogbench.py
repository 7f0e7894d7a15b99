"""OGBench's datasets of a single task, with rewards and masks of `relabel_dataset` of seohongpark/ogbench 1.2."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np

from quad_rl import _quad_rl
from quad_rl._extras import library
from quad_rl._rows import Source, rows_from_arrays


def from_ogbench(name: str, *, folder: str | PathLike[str] = "~/.ogbench/data") -> Source:
    """A dataset of OGBench with the rewards of a task, like "antmaze-large-navigate-singletask-task1-v0".

    folder: where OGBench keeps its files. One that is missing is downloaded by the library ogbench.

    Mazes need nothing but the file: their goals are known. The rewards of others come from the library, which simulates the
    task's first state. Without a task, it is OGBench's default. A step is terminal where the
    state before it has reached the task, as OGBench has it. Raises ValueError for a name without a task, OSError for a file that
    is neither there nor to be had, ImportError without ogbench where it is needed.
    """
    folder = Path(folder).expanduser()
    tasks = {task: (dataset, maze) for task, dataset, maze in _quad_rl.benchmark_tasks("OGBench")}
    if name not in tasks:
        own = [task for task, (dataset, _) in tasks.items() if dataset == name]
        if not own:
            raise ValueError(f"OGBench has no task {name}")
        raise ValueError(f"{name} has no rewards, as it is for any goal; learning needs one task of it\nhint: {own[1]}")
    file, maze = tasks[name]
    if not (folder / f"{file}.npz").exists():
        _download(file, folder)
    if not maze:
        data, _ = library("ogbench", "ogbench").make_env_and_datasets(name, dataset_dir=str(folder), compact_dataset=False)[1:]
        ends, masks, rewards = data["terminals"] > 0, data["masks"], data["rewards"]
        before, actions, after = data["observations"], data["actions"], data["next_observations"]
    else:
        goal, reach, x = maze
        with np.load(folder / f"{file}.npz") as arrays:
            last = arrays["terminals"] > 0
            steps = ~last & (np.arange(len(last)) + 1 < len(last))  # The last state of a trajectory begins no step.
            after = arrays["observations"][1:][steps[:-1]]
            before, actions, qpos = (arrays[key][steps] for key in ("observations", "actions", "qpos"))
            ends = np.append(last[1:], True)[steps]
        reached = np.linalg.norm(qpos[:, x : x + 2] - np.array(goal), axis=-1) <= reach
        rewards, masks = reached - 1.0, 1.0 - reached
    return Source(rows_from_arrays("", before, actions, rewards, masks == 0, ends & (masks != 0), after))


def _download(file: str, folder: Path) -> None:
    ogbench = library("ogbench", "ogbench")
    try:
        ogbench.download_datasets([file], str(folder))
    except OSError as error:
        hint = f"hint: put it and {file}-val.npz there, from {ogbench.utils.DATASET_URL}"
        raise OSError(f"{folder} has no {file}.npz, which cannot be downloaded: {error}\n{hint}") from None
