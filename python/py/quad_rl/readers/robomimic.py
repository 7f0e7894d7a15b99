"""robomimic's HDF5 files: a group `data/demo_N` for each episode."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl import _dataset
from quad_rl._extras import library
from quad_rl.readers.episodes import Episode, Log, Rule, Success, columns_of, dataset


def from_robomimic(
    file: str | PathLike[str],
    *,
    observations: Sequence[str],
    actions: str = "actions",
    reward: Rule = "rewards",
    success: Success = None,
    terminate: Rule = None,
    filter: str | None = None,
) -> _dataset.Dataset:
    """A file of robomimic or of what writes its layout (robosuite, RoboCasa, mimicgen). Needs h5py.

    observations: the keys below `obs` that are seen, in this order, such as ["object", "robot0_eef_pos"]; no images.
    actions: the array that is done.
    reward, success: as in `from_frame`, columns being arrays and names those of the groups, such as "demo_3".
    terminate: as `terminal` in `from_frame`; by default `dones`, if they are set only where there is a reward: written with
        another --done_mode they also stand at the end of each demonstration.
    filter: the list of `mask` that says which demonstrations are read, such as "train"; None: all of them.

    Without `next_obs`, the last step of an episode that does not terminate is dropped. Raises ValueError for what has to be
    said and is not, ImportError without h5py.
    """
    h5py, done = library("h5py", "robomimic"), "dones"
    with h5py.File(file) as opened:
        if "data" not in opened or not any(name.startswith("demo") for name in opened["data"]):
            raise ValueError(f"{file} is no file of robomimic's: it has no group data/demo_0")
        names: list[str] = sorted(opened["data"], key=lambda name: (len(name), name))  # demo_2 before demo_10.
        notes: list[str] = []
        there: list[str] = []
        if filter is not None:
            masks = opened.get("mask", {})
            if filter not in masks:
                raise ValueError(f"{file}: there is no filter {filter!r}\nhint: there are {', '.join(masks) or 'none'}")
            chosen = {name.decode() if isinstance(name, bytes) else str(name) for name in masks[filter][()]}
            notes.append(f"{len([n for n in names if n not in chosen])} of {len(names)} episodes left out: not in {filter!r}")
            names = [name for name in names if name in chosen]
        words = columns_of(observations, actions, reward, success, terminate)
        episodes: list[Episode] = []
        for name in names:
            group = opened["data"][name]
            low, images = _sort(group)
            there = list(low)
            for key in {*observations} & {*images}:
                raise ValueError(f"{file}: {key} holds images, but only rows of numbers are learnt from")
            if images and not episodes:
                notes.append(f"left out: {len(images)} streams of images ({', '.join(images)})")
            columns = {key: low[key][()] for key in low if words is None or key in words or key == done}
            after = group.get("next_obs", {})
            last = {key: after[key][-1:] for key in observations if key in after}
            episodes.append(Episode(name, columns, last if len(last) == len(observations) else {}))
    done = done if all(done in episode.columns for episode in episodes) else ""
    if done and terminate is None and success is None and _pays(episodes, reward, done):
        terminate = done
    return dataset(Log(episodes, notes, there, done=done), observations, [actions], reward, success, terminate)


def _sort(group: Any) -> tuple[dict[str, Any], list[str]]:
    """Arrays of rows of numbers by their names, those of `obs` among them, and names of images."""
    arrays = {**{name: group[name] for name in group}, **{key: group["obs"][key] for key in group.get("obs", {})}}
    arrays = {name: array for name, array in arrays.items() if hasattr(array, "dtype")}
    images = [name for name, array in arrays.items() if array.ndim > 2]
    return {name: array for name, array in arrays.items() if name not in images}, images


def _pays(episodes: list[Episode], reward: Rule, done: str) -> bool:
    """Whether `dones` are set, and only where there is a reward."""
    if not isinstance(reward, str) or not all(reward in episode.columns for episode in episodes):
        return False
    flags: NDArray[Any] = np.concatenate([episode.columns[done].reshape(-1) > 0 for episode in episodes])
    return bool(flags.any()) and bool((np.concatenate([e.columns[reward].reshape(-1) for e in episodes])[flags] > 0).all())
