"""Transitions as checked arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

_NAMES = {"terminations": "terminated", "truncations": "truncated"}
_AMOUNTS = "hint: pass amounts, such as torques, as floats: actions.astype(float); readers take continuous=True, quad-convert --continuous"


class Rows(NamedTuple):
    """Transitions in the layout of the file."""

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    terminals: NDArray[np.bool_]
    timeouts: NDArray[np.bool_]


class Source(NamedTuple):
    """Contents of another program's data."""

    rows: Rows
    names: tuple[list[str], list[str]] = ([], [])  # Of the numbers of an observation, and of an action.
    notes: list[str] = []


def rows_from_episodes(episodes: Iterable[Any]) -> Rows:
    parts = [episode_rows(f"episode {i}: ", episode) for i, episode in enumerate(episodes)]
    if not parts:
        raise ValueError("there is no episode")
    return joined(parts)


def joined(parts: Iterable[Rows]) -> Rows:
    """The rows of all episodes."""
    try:
        return Rows(*(np.concatenate(arrays) for arrays in zip(*parts)))
    except ValueError as error:
        raise ValueError(f"all episodes must have observations and actions of the same size: {error}") from None


def episode_rows(where: str, episode: Any) -> Rows:
    def get(name: str) -> Any:
        for key in (name, _NAMES.get(name, name)):
            if isinstance(episode, Mapping) and key in episode:
                return episode[key]
            if hasattr(episode, key):
                return getattr(episode, key)
        raise ValueError(f"{where}there are no {name}")

    steps = len(get("rewards"))
    if not steps:
        raise ValueError(f"{where}it has no step")
    ends = []
    for name in _NAMES:
        flags = plain(where, name, get(name))
        ends.append(flags if flags.ndim else np.where(np.arange(steps) == steps - 1, flags, 0))
    observations = plain(where, "observations", get("observations"))
    after = observations[1:] if len(observations) == steps + 1 else None
    before = observations if after is None else observations[:-1]
    rows = rows_from_arrays(where, before, get("actions"), get("rewards"), ends[0], ends[1], after)
    if after is None:
        return followed(rows)
    rows.timeouts[-1] |= not rows.terminals[-1]
    return rows


def rows_from_arrays(
    where: str,
    observations: ArrayLike,
    actions: ArrayLike,
    rewards: ArrayLike,
    terminations: ArrayLike,
    truncations: ArrayLike,
    next_observations: ArrayLike | None,
) -> Rows:
    if np.asarray(actions).dtype.kind in "iub":
        raise ValueError(f"{where}actions are integers, as if they were discrete; only continuous actions can be learned\n{_AMOUNTS}")
    r = _array(where, "rewards", rewards, None, 1)
    n = len(r)
    o = _array(where, "observations", observations, n, 2)
    return Rows(
        o,
        _array(where, "actions", actions, n, 2),
        r,
        o if next_observations is None else _array(where, "next_observations", next_observations, n, 2, o.shape[1]),
        _flags(where, "terminations", terminations, n),
        _flags(where, "truncations", truncations, n),
    )


def plain(where: str, name: str, values: Any) -> NDArray[Any]:
    """As an array. Raises ValueError for masked values, which were not recorded."""
    if np.ma.is_masked(values):
        rows = np.unique(np.nonzero(np.ma.getmaskarray(values))[0])
        hint = "hint: leave these rows out, or fill them, as by numpy.ma's filled(0)"
        raise ValueError(f"{where}{name}, row {rows[0]} is masked ({len(rows)} such rows)\n{hint}")
    return np.asarray(values)


def _flags(where: str, name: str, values: ArrayLike, rows: int) -> NDArray[np.bool_]:
    array = _array(where, name, values, rows, 1)
    bad = np.flatnonzero((array != 0) & (array != 1))
    if len(bad):
        raise ValueError(f"{where}{name}, row {bad[0]}: {array[bad[0]]} is neither 0 nor 1 ({len(bad)} such rows)")
    return array.astype(bool)


def _array(
    where: str, name: str, values: ArrayLike, rows: int | None, axes: int, width: int | None = None
) -> NDArray[np.float32]:
    """Finite numbers [N] or [N, width]."""
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(plain(where, name, values), dtype=np.float32)
    shape, n = list(array.shape), "N" if rows is None else rows
    if array.ndim == 1 and axes == 2 or shape[1:] == [1] and axes == 1:
        array = array.reshape([-1, 1][:axes])
    if array.ndim != axes or rows not in (None, len(array)) or width not in (None, array.shape[-1]):
        expected = f"[{n}, {width or 'k'}]" if axes == 2 else f"[{n}]"
        raise ValueError(f"{where}{name} has shape {shape}, but must have {expected}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        (row, *column), rows = bad[0], len(set(bad[:, 0]))
        number = f"number {column[0]}" if column else "it"
        value = array[tuple(bad[0])]
        raise ValueError(f"{where}{name}, row {row}: {number} is {value}, but must be a finite float32 ({rows} such rows)")
    return array


def followed(rows: Rows) -> Rows:
    """Adds next observations, and drops the steps without one."""
    o, terminals, timeouts = rows.observations, rows.terminals, rows.timeouts
    after = np.concatenate([o[1:], o[-1:]])
    after[terminals] = o[terminals]  # Unused.
    dropped = timeouts & ~terminals
    dropped[-1:] |= ~terminals[-1:]
    # An episode whose last step is dropped ends with the step before.
    ends = timeouts & terminals
    ends[:-1] |= dropped[1:] & ~terminals[:-1]
    kept = ~dropped
    return Rows(o[kept], rows.actions[kept], rows.rewards[kept], after[kept], terminals[kept], ends[kept])
