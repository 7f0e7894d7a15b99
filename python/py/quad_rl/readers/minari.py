"""Minari's datasets, in any of its storages."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._extras import needing
from quad_rl._rows import Source
from quad_rl.readers.episodes import Episode, Log, dataset
from quad_rl.readers.hdf5 import opened

_ACTIONS, _REWARDS, _TERMINATIONS = "actions", "rewards", "terminations"


def from_minari(id_or_folder: str | PathLike[str]) -> Source:
    """A dataset of Minari, stored as HDF5, Arrow or Parquet. Needs minari, with what it needs for that storage.

    id_or_folder: an id such as "mujoco/hopper/medium-v0", which Minari downloads if it is not on this machine; or the folder of
        a dataset, or its folder `data`.

    Dicts and Tuples become one row, in the order of Gymnasium's `flatten`, also those within others. Steps are terminal where
    `terminations` are. Where an episode has no observation after its last step, as older ones have not, that step is
    dropped unless it is terminal. Raises ValueError for images, texts and discrete actions, ImportError without minari.
    """
    with needing("minari"):  # Also while it reads: it imports a storage's libraries then.
        return _read(Path(id_or_folder))


def _read(place: Path) -> Source:
    minari: Any = importlib.import_module("minari")

    folders = [place / "data", place]
    folder = next((folder for folder in folders if (folder / "metadata.json").is_file()), None)
    data = minari.MinariDataset(folder) if folder else minari.load_dataset(str(place), download=True)
    for file in Path(data.storage.data_path).glob("*.hdf5"):
        with opened(file, "minari"):
            pass
    episodes, seen, done = [], {}, {}
    for episode in data.iterate_episodes():
        steps = len(episode.rewards)
        seen = _parts("observations", data.observation_space, episode.observations)
        done = _parts(_ACTIONS, data.action_space, episode.actions)
        columns = {_REWARDS: np.asarray(episode.rewards), _TERMINATIONS: np.asarray(episode.terminations), **done}
        columns |= {name: array[:steps] for name, array in seen.items()}
        last = {name: array[steps:] for name, array in seen.items() if len(array) > steps}
        episodes.append(Episode(int(episode.id), columns, last))
    return dataset(Log(episodes, []), [*seen], [*done], _REWARDS, None, _TERMINATIONS)


def _parts(name: str, space: Any, values: Any) -> dict[str, NDArray[Any]]:
    """The arrays of a Dict or a Tuple in its order, which is that of Gymnasium's `flatten`, or the only one."""
    inner = getattr(space, "spaces", ())
    if inner:
        parts = inner.items() if isinstance(inner, Mapping) else enumerate(inner)
        return {full: array for key, part in parts for full, array in _parts(f"{name}.{key}", part, values[key]).items()}
    array = np.asarray(values)
    if array.ndim > 2 and array.dtype == np.uint8:
        raise ValueError(f"{name} holds images, but only rows of numbers are learned from")
    return {name: array}
