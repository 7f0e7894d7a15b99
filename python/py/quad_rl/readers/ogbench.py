"""OGBench's datasets of a single task.

Rewards and masks are those of `relabel_dataset` of seohongpark/ogbench 1.2: r(s), where s has reached the task.
"""

from __future__ import annotations

import re
from os import PathLike
from pathlib import Path

import numpy as np

from quad_rl import _dataset
from quad_rl._extras import library

# The cell (i, j) of the goal of tasks 1 to 5; it lies at x = 4 j - 4, y = 4 i - 4.
_GOALS = {
    "medium": [(6, 6), (1, 6), (4, 2), (6, 1), (1, 1)],
    "large": [(7, 10), (7, 1), (1, 10), (5, 4), (5, 4)],
    "giant": [(10, 14), (10, 1), (1, 1), (5, 12), (3, 8)],
}
_NAME = re.compile(r"(point|ant|humanoid)maze-(medium|large|giant)-\w+-singletask(?:-task([1-5]))?-v0")


def from_ogbench(name: str, *, folder: str | PathLike[str] = "~/.ogbench/data") -> _dataset.Dataset:
    """A dataset of OGBench with the rewards of a task, like "antmaze-large-navigate-singletask-task1-v0".

    folder: where OGBench keeps its files. One that is missing is downloaded by the library ogbench.

    Mazes of point, ant and humanoid need nothing but the file: their goals are known. The rewards of others come from the
    library, which simulates the task's first state. Without a task, it is OGBench's default. A step is terminal where the
    state before it has reached the task, as OGBench has it. Raises ValueError for a name without a task, OSError for a file that
    is neither there nor to be had, ImportError without ogbench where it is needed.
    """
    folder = Path(folder).expanduser()
    if "-singletask" not in name:
        hint = f"hint: {name.replace('-v0', '')}-singletask-task1-v0"
        raise ValueError(f"{name} has no rewards, as it is for any goal; learning needs one task of it\n{hint}")
    file = re.sub("-singletask(-task[1-5])?", "", name)
    if not (folder / f"{file}.npz").exists():
        _download(file, folder)
    maze = _NAME.fullmatch(name)
    if not maze:
        data, _ = library("ogbench", "ogbench").make_env_and_datasets(name, dataset_dir=str(folder), compact_dataset=False)[1:]
        ends, masks, rewards = data["terminals"] > 0, data["masks"], data["rewards"]
        before, actions, after = data["observations"], data["actions"], data["next_observations"]
    else:
        robot, size, task = maze.groups()
        with np.load(folder / f"{file}.npz") as arrays:
            last = arrays["terminals"] > 0
            steps = ~last & (np.arange(len(last)) + 1 < len(last))  # The last state of a trajectory begins no step.
            after = arrays["observations"][1:][steps[:-1]]
            before, actions, place = (arrays[key][steps] for key in ("observations", "actions", "qpos"))
            ends = np.append(last[1:], True)[steps]
        row, column = _GOALS[size][int(task or 1) - 1]
        goal = np.array([4.0 * column - 4.0, 4.0 * row - 4.0])
        reached = np.linalg.norm(place[:, :2] - goal, axis=-1) <= (1.0 if robot == "point" else 0.5)
        rewards, masks = reached - 1.0, 1.0 - reached
    flags = {"terminations": masks == 0, "truncations": ends & (masks != 0)}
    return _dataset.Dataset.from_arrays(observations=before, actions=actions, rewards=rewards, next_observations=after, **flags)


def _download(file: str, folder: Path) -> None:
    ogbench = library("ogbench", "ogbench")
    try:
        ogbench.download_datasets([file], str(folder))
    except OSError as error:
        hint = f"hint: put it and {file}-val.npz there, from {ogbench.utils.DATASET_URL}"
        raise OSError(f"{folder} has no {file}.npz, which cannot be downloaded: {error}\n{hint}") from None
