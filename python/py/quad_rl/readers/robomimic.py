"""robomimic's HDF5 files: a group `data/demo_N` for each episode."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._rows import Source
from quad_rl.readers.episodes import Episode, Log, Rule, Success, dataset, rule_columns
from quad_rl.readers.hdf5 import opened

_REWARDS, _SUCCESS, _DONE = "rewards", "success", "dones"


def from_robomimic(
    file: str | PathLike[str],
    *,
    observations: Sequence[str],
    actions: str | Sequence[str] = "actions",
    reward: Rule = None,
    success: Success = None,
    terminate: Rule = None,
    filter: str | None = None,
    continuous: bool = False,
) -> Source:
    """A file of robomimic or of what writes its layout (robosuite, RoboCasa, mimicgen, Isaac Lab). Needs h5py.

    observations: the keys below `obs` that are seen, in this order, such as ["object", "robot0_eef_pos"]; no images. Where `obs`
        is an array, as Isaac Lab writes it, ["obs"].
    actions: the array that is done, or several, in this order.
    reward, success: as in `from_frame`, columns being arrays and names those of the groups, such as "demo_3". By default
        `rewards` and, where demonstrations have it, their attribute `success`.
    terminate: as `terminal` in `from_frame`; by default `dones`, if they are set only where there is a reward: written with
        another --done_mode they also stand at the end of each demonstration.
    filter: the list of `mask` that says which demonstrations are read, such as "train"; None: all of them.
    continuous: as in `from_frame`.

    Without `next_obs`, the last step of an episode that does not terminate is dropped. Raises ValueError for what has to be
    said and is not, and for `next_obs` that are not the following rows of `obs`; ImportError without h5py.
    """
    actions = [actions] if isinstance(actions, str) else actions
    with opened(file, "robomimic") as source:
        if "data" not in source or not any(name.startswith("demo") for name in source["data"]):
            hint = "hint: `learner train --dataset` reads D4RL's and your own HDF5 files as they are (docs/data.md)"
            raise ValueError(f"{file} is no file of robomimic's: it has no group data/demo_0\n{hint}")
        names: list[str] = sorted(source["data"], key=lambda name: (len(name), name))  # demo_2 before demo_10.
        notes: list[str] = []
        there: list[str] = []
        if filter is not None:
            masks = source.get("mask", {})
            if filter not in masks:
                raise ValueError(f"{file}: there is no filter {filter!r}\nhint: there are {', '.join(masks) or 'none'}")
            chosen = {name.decode() if isinstance(name, bytes) else str(name) for name in masks[filter][()]}
            notes.append(f"{len([n for n in names if n not in chosen])} of {len(names)} episodes left out: not in {filter!r}")
            names = [name for name in names if name in chosen]
        words = rule_columns(observations, actions, reward, success, terminate)
        episodes: list[Episode] = []
        for name in names:
            group = source["data"][name]
            for key in {*actions} & {*observations} & {*_below(group, "obs")}:
                raise ValueError(f"{file}: {key!r} is both seen, below obs, and done\nhint: copy one of these arrays to another name")
            low, images = _sort(group, observations)
            there = list(low)
            for key in {*observations} & {*images}:
                raise ValueError(f"{file}: {key} holds images, but only rows of numbers are learned from")
            if images and not episodes:
                notes.append(f"left out: {len(images)} streams of images ({', '.join(images)})")
            columns = {key: low[key][()] for key in low if words is None or key in {*words, _REWARDS, _DONE}}
            after = {key: array[()] for key, array in _below(group, "next_obs").items() if key in observations}
            for key in [key for key in after if key in columns]:
                _check_following(f"{file}: {name}", key, columns[key], after[key])
            last = {key: array[-1:] for key, array in after.items()}
            episodes.append(Episode(name, columns, last if len(last) == len(observations) else {}))
            if _SUCCESS in group.attrs and _SUCCESS not in low:
                columns[_SUCCESS] = np.full(episodes[-1].steps, bool(group.attrs[_SUCCESS]))
    full = [episode.columns for episode in episodes if episode.steps]
    rewarded = _REWARDS if any(_REWARDS in columns for columns in full) else ""
    won, done = (name if all(name in columns for columns in full) else "" for name in (_SUCCESS, _DONE))
    if done and terminate is None and success is None and not won and _pays(full, reward or rewarded):
        terminate = done
    log = Log(episodes, notes, there, reward=rewarded, success=won, done=done, continuous=continuous)
    return dataset(log, observations, actions, reward, success, terminate)


def _below(group: Any, name: str) -> dict[str, Any]:
    """The arrays of a group or, where there is an array in its place, that one as `obs`."""
    there = group.get(name, {})
    return {"obs": there} if hasattr(there, "dtype") else {key: one for key, one in there.items() if hasattr(one, "dtype")}


def _sort(group: Any, observations: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """Arrays of rows of numbers by their names, those of `obs` among them, and names of images.

    A name of two arrays is that below `obs` if it is observed, else the demonstration's own: Isaac Lab's `obs/actions` are the
    actions before.
    """
    own = {name: group[name] for name in group if hasattr(group[name], "dtype")}
    arrays = own | {name: array for name, array in _below(group, "obs").items() if name in observations or name not in own}
    images = [name for name, array in arrays.items() if array.ndim > 2]
    return {name: array for name, array in arrays.items() if array.ndim in (1, 2)}, images


def _check_following(where: str, key: str, seen: NDArray[Any], after: NDArray[Any]) -> None:
    """Raises ValueError where a row of `next_obs` is not the following row of `obs`, as that is what is learned from."""
    if len(seen) != len(after):
        raise ValueError(f"{where}: next_obs has {len(after)} rows of {key!r}, but obs has {len(seen)}")
    coarse = min(seen.dtype, after.dtype, key=lambda dtype: dtype.itemsize)  # One of them may have been rounded.
    following, there = seen[1:].astype(coarse), after[:-1].astype(coarse)
    differs = (following != there) & ((following == following) | (there == there))  # NaN has its own error.
    rows = np.flatnonzero(differs.any(axis=tuple(range(1, differs.ndim))))
    if len(rows):
        hint = "hint: rows between them were left out; Dataset.from_arrays takes next_observations of any rows"
        raise ValueError(f"{where}: next_obs, row {rows[0]} of {key!r} is not the following row of obs ({len(rows)} such rows)\n{hint}")


def _pays(columns: list[dict[str, NDArray[Any]]], reward: Rule) -> bool:
    """True if `dones` are set, and only where there is a reward."""
    if not isinstance(reward, str) or not all(reward in demonstration for demonstration in columns):
        return False
    flags: NDArray[Any] = np.concatenate([demonstration[_DONE].reshape(-1) > 0 for demonstration in columns])
    return bool(flags.any()) and bool((np.concatenate([demonstration[reward].reshape(-1) for demonstration in columns])[flags] > 0).all())
