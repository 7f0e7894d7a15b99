"""Tables: data frames, CSV, Parquet."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl import _dataset
from quad_rl._extras import library
from quad_rl.readers.arrow import array_of
from quad_rl.readers.episodes import Episode, Log, Rule, Success, columns_of, dataset


def from_frame(
    frame: Any,
    *,
    observations: Sequence[str],
    actions: Sequence[str],
    reward: Rule,
    episode: str,
    terminal: Rule = None,
    success: Success = None,
) -> _dataset.Dataset:
    """A table with a row for each step, in the order of recording.

    frame: a data frame (pandas, Polars, a pyarrow Table, a dictionary of arrays), or the path of a CSV or Parquet file, which
        needs pyarrow.
    observations, actions: the columns that are seen and done, in this order; one may hold lists. They are called so in the
        file and in the policy.
    reward: a column; "success-at-end", which is 1 at the last step of a success and else 0; "step-cost", which is -1, and 0
        there; or a function of the episode, a dictionary of columns, that gives a number for each step.
    episode: the column whose rows of the same value are an episode.
    terminal: where the task itself was over after the step: a column of flags, "success" (the last step of a success), "never",
        or a function of the episode. By default "success" if that is known.
    success: which episodes are successes: a column that is above 0 in one of their rows, "all", a list of their names, or a
        function of the episode.

    What followed the last step of an episode that does not terminate is not in a table, so that step is dropped, as
    `from_arrays` does it. Raises ValueError for what is missing, ImportError without pyarrow.
    """
    path = isinstance(frame, (str, PathLike))
    place = os.fspath(frame) if path else "the table"
    table = _read(place) if path else frame
    there = [str(name) for name in getattr(table, "column_names", getattr(table, "columns", table))]
    words = columns_of(observations, actions, reward, terminal, success)
    columns = {name: _column(table, name, place) for name in there if words is None or name in words or name == episode}
    if episode not in columns:
        raise ValueError(f"{place}: there is no column {episode!r} for episodes\nhint: there are {', '.join(map(repr, there))}")
    names, first, inverse = np.unique(columns[episode], return_index=True, return_inverse=True)
    place_of = np.argsort(np.argsort(first))[inverse]  # Episodes in the order in which they begin.
    order, notes = np.argsort(place_of, kind="stable"), []
    apart = int((np.bincount(place_of[np.diff(place_of, prepend=-1) != 0], minlength=1) > 1).sum())
    if apart:
        notes.append(f"{apart} of {len(names)} episodes: their rows do not lie together; they count in the table's order")
    cuts = np.cumsum(np.bincount(place_of, minlength=1))[:-1]
    parts = zip(*(np.split(array[order], cuts) for array in columns.values())) if len(names) else ()
    episodes = [Episode(name, dict(zip(columns, part)), {}) for name, part in zip(names[np.argsort(first)].tolist(), parts)]
    return dataset(Log(episodes, notes, there, end="terminal"), observations, actions, reward, success, terminal)


def _column(table: Any, name: str, place: str) -> NDArray[Any]:
    column = table[name]
    if hasattr(column, "combine_chunks"):
        return array_of(column, name, place)
    to_numpy: Callable[[], Any] | None = getattr(column, "to_numpy", None)
    array = np.asarray(to_numpy() if to_numpy else column)
    if array.dtype == object and len(array) and not isinstance(array[0], str):
        return np.stack([np.asarray(row) for row in array])
    return array


def _read(path: str) -> Any:
    library("pyarrow", "table")
    with open(path, "rb") as file:
        first = file.readline(1 << 16)
    if first.startswith(b"PAR1"):
        return library("pyarrow.parquet", "table").read_table(path)
    csv = library("pyarrow.csv", "table")
    delimiter = max(",;\t", key=first.decode(errors="replace").count)
    return csv.read_csv(path, parse_options=csv.ParseOptions(delimiter=delimiter))
