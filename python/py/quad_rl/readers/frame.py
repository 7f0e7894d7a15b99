"""Tables: data frames, CSV, Parquet."""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Callable, Sequence
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._extras import library
from quad_rl._rows import Source, plain
from quad_rl.readers.arrow import to_array
from quad_rl.readers.episodes import FEWEST, Episode, Log, Rule, Success, dataset, is_number, rule_columns

TABLES = (".csv", ".tsv", ".parquet")  # Of the files in a folder.
_EMPTY = {"", "nan", "none", "nat", "<na>", "null"}  # Empty places, as libraries of tables write them.
_CLOCK = re.compile(r"(^t|time|stamp)(_?(s|ms|us|ns|sec|seconds))?$", re.IGNORECASE)
_ENDS = {"done", "dones", "terminal", "terminals", "terminated"}
_GAP = 1.5  # Of a step's usual length.


def from_frame(
    frame: Any,
    *,
    observations: Sequence[str],
    actions: Sequence[str],
    reward: Rule,
    episode: str,
    terminal: Rule = None,
    success: Success = None,
    apart: str | None = None,
    continuous: bool = False,
) -> Source:
    """A table with a row for each step, in the order of recording.

    frame: a data frame (pandas, Polars, a pyarrow Table, a dictionary of arrays), or the path of a CSV or Parquet file, or of a
        folder of them, which needs pyarrow. The column "file" has the name of a folder's file, without its ending.
    observations, actions: the columns that are seen and done, in this order; one may hold lists. They are called so in the
        file and in the policy. "q*" stands for all columns of such names that are nothing else, in the table's order.
    reward: a column; "success-at-end", which is 1 at the last step of a success and else 0; "step-cost", which is -1, and 0
        there; "none", which is 0, for data to clone; or a function of the episode, a dictionary of columns, that gives a number
        for each step.
    episode: the column whose rows of the same value are an episode.
    terminal: where the task itself was over after the step: a column of flags, "success" (the last step of a success), "never",
        or a function of the episode. By default "success" if that is known.
    success: which episodes are successes: a column that is above 0 in one of their rows, "all", a list of their names, or a
        function of the episode.
    apart: what rows of the same value are that do not lie together: "interleaved", one episode, recorded at once with others; or
        "repeated", several episodes, as in logs that were put together. By default such rows are refused.
    continuous: whole numbers in `actions` are amounts, such as torques, and no choices.

    What followed the last step of an episode that does not terminate is not in a table, so that step is dropped, as
    `from_arrays` does it. `notes` of the result says where times, in columns with such a name, leap, stand still or go back.
    Raises ValueError for what is missing, ImportError without pyarrow.
    """
    path = isinstance(frame, (str, PathLike))
    place = os.fspath(frame) if path else "the table"
    table = _read(place) if path else frame
    keys = [*getattr(table, "column_names", getattr(table, "columns", table))]  # pandas's may be numbers.
    there = [str(key) for key in keys]
    if path and not {*observations, *actions, episode} & {*there} and any(map(is_number, there)):
        hint = "hint: write one above them, such as " + ",".join([*observations, *actions, episode])
        raise ValueError(f"{place} has no line of names: its first line is {', '.join(there)}\n{hint}")
    named = {episode, *(rule for rule in (reward, terminal, success) if isinstance(rule, str))}
    actions = _matching(actions, there, named)
    observations = _matching(observations, there, {*named, *actions})
    words = rule_columns(observations, actions, reward, terminal, success)
    read = {name: key for name, key in zip(there, keys) if words is None or name in words or name == episode}
    for name in [name for name in read if there.count(name) > 1]:
        raise ValueError(f"{place} has several columns {name!r}")
    for name in read if path and os.path.isdir(place) else ():
        files = table.filter(table[name].is_null())["file"].unique().to_pylist()
        if files:
            raise ValueError(f"{place}: column {name!r} is missing or has empty places in {len(files)} of the files, such as {files[0]!r}")
    columns = {name: _column(table[key], name, place) for name, key in read.items()}
    if episode not in columns:
        raise ValueError(f"{place}: there is no column {episode!r} for episodes\nhint: there are {', '.join(map(repr, there))}")
    for name in [name for name in columns if len(columns[name]) != len(columns[episode])]:
        raise ValueError(f"{place}: column {name!r} has {len(columns[name])} rows, but {episode!r} has {len(columns[episode])}")
    names, owners, notes = _episodes(columns[episode], episode, place, apart)
    for name, key in zip(there, keys):
        if _CLOCK.search(name) and name != episode and there.count(name) == 1:
            notes += _leaps(table[key], name, owners)
    ends = [name for name in there if name.lower() in _ENDS]
    if ends and terminal is None and success is None:
        notes.append(f"no terminal is given: {ends[0]!r}, if that says where the task was over?")
    order, cuts = np.argsort(owners, kind="stable"), np.cumsum(np.bincount(owners, minlength=1))[:-1]
    parts = zip(*(np.split(array[order], cuts) for array in columns.values())) if names else ()
    episodes = [Episode(name, dict(zip(columns, part)), {}) for name, part in zip(names, parts)]
    log = Log(episodes, notes, there, end="terminal", continuous=continuous)
    return dataset(log, observations, actions, reward, success, terminal)


def _episodes(ids: NDArray[Any], column: str, place: str, apart: str | None) -> tuple[list[Any], NDArray[Any], list[str]]:
    """Names of episodes in the order in which they begin, the place of each row's among them, and notes."""
    if apart not in (None, "interleaved", "repeated"):
        raise ValueError(f'apart is {apart!r}, not "interleaved" or "repeated"')
    listed = (ids.astype(str) if ids.dtype.kind in "mM" else ids).tolist()
    empty = [row for row, name in enumerate(listed) if str(name).strip().lower() in _EMPTY]
    if empty:
        hint = "hint: leave these rows out, or say of which episode they are"
        raise ValueError(f"{place}: column {column!r}, row {empty[0]} is empty: of no episode ({len(empty)} such rows)\n{hint}")
    numbers: dict[Any, int] = {}
    owners = np.array([numbers.setdefault(name, len(numbers)) for name in listed], int)
    begins = np.diff(owners, prepend=-1) != 0
    torn = [name for name, stretches in zip(numbers, np.bincount(owners[begins], minlength=1)) if stretches > 1]
    if not torn:
        return list(numbers), owners, []
    those = f"{len(torn)} of {len(numbers)} episodes: their rows do not lie together"
    if apart is None:
        hint = 'apart="interleaved" if they were recorded at once, "repeated" if such a name is that of several episodes'
        raise ValueError(f"{place}: {those}, as those of {column!r} {torn[0]!r}\nhint: {hint} (quad-convert --apart)")
    if apart == "interleaved":
        return list(numbers), owners, [f"{those}; they count in the table's order"]
    names = [listed[row] for row in np.flatnonzero(begins)]
    return names, np.cumsum(begins) - 1, [f"{len(torn)} of {len(numbers)} names are those of several episodes: {len(names)} in all"]


def _leaps(column: Any, name: str, owners: NDArray[Any]) -> list[str]:
    """Tells of rows that are missing, there twice or out of order, by their times."""
    try:
        array = _column(column, name, "")
        times = array.astype("M8[ns]").astype(float) / 1e9 if array.dtype.kind == "M" else array.astype(float).reshape(owners.shape)
    except (TypeError, ValueError):  # Texts, empty places, lists.
        return []
    order = np.argsort(owners, kind="stable")
    steps = np.diff(times[order])[np.diff(owners[order]) == 0]
    ahead, still, back = steps[steps > 0], np.count_nonzero(steps == 0), np.count_nonzero(steps < 0)
    if len(ahead) < max(FEWEST, len(steps) / 2) or 10 * back > len(steps):
        return []  # No clock.
    usual = np.median(ahead)
    long = ahead[ahead > _GAP * usual]
    told = [f"{len(long)} take more than {_GAP} times the usual {usual:.3g}, up to {long.max():.3g}, as if rows were missing: "
            "begin another episode there"] if len(long) else []
    told += [f"{still} take no time, as if rows were there twice"] if still else []
    told += [f"{back} go back: sort the rows"] if back else []
    return [f"of {len(steps)} steps, by their {name!r}, {'; '.join(told)}"] if told else []


def _matching(names: Sequence[str], there: list[str], named: set[str]) -> Sequence[str]:
    """The columns of these names or patterns, each once, by patterns none of `named`; what matches none stays, to be refused."""
    if isinstance(names, str):
        return names
    free = [name for name in there if name not in named]
    matches = ([name] if name in there else fnmatch.filter(free, name) or [name] for name in names)
    return [*dict.fromkeys(chain.from_iterable(matches))]


def _column(column: Any, name: str, place: str) -> NDArray[Any]:
    if hasattr(column, "combine_chunks"):
        return to_array(column, name, place)
    to_numpy: Callable[[], Any] | None = getattr(column, "to_numpy", None)
    array = plain(f"{place}: ", name, to_numpy() if to_numpy else column)
    if array.dtype == object and len(array) and not isinstance(array[0], str):
        rows = [np.asarray(row) for row in array]
        if len({row.shape for row in rows}) > 1:
            raise ValueError(f"{place}: column {name!r} has lists of several lengths, or empty places")
        return np.stack(rows)
    return array


def _read(path: str) -> Any:
    pa = library("pyarrow", "table")
    if os.path.isdir(path):
        files = [file for file in sorted(Path(path).iterdir()) if file.suffix.lower() in TABLES]
        tables = [(file.stem, _read(str(file))) for file in files]
        tables = [table.append_column("file", pa.array([stem] * len(table), pa.string())) for stem, table in tables]
        return pa.concat_tables(tables, promote_options="permissive")
    with open(path, "rb") as file:
        first = file.readline(1 << 16)
    try:
        if first.startswith(b"PAR1"):
            return library("pyarrow.parquet", "table").read_table(path)
        csv = library("pyarrow.csv", "table")
        delimiter = max(",;\t", key=first.decode(errors="replace").count)
        table = csv.read_csv(path, parse_options=csv.ParseOptions(delimiter=delimiter))
        _ = table.column_names  # Decodes them.
        return table
    except (pa.ArrowInvalid, UnicodeDecodeError) as error:
        hint = ("hint: its writer must have closed it; a CSV file is in UTF-8, and each line has as many fields as the first, which has "
                "the names")
        raise ValueError(f"{path} is no whole CSV or Parquet file: {error}\n{hint}") from None
