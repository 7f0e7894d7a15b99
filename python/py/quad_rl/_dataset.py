"""Data from arrays."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_rl import _quad_rl

_NAMES = {"terminations": "terminated", "truncations": "truncated"}


class _Rows(NamedTuple):
    """Transitions as the file has them."""

    observations: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    terminals: NDArray[np.bool_]
    timeouts: NDArray[np.bool_]


class Dataset:
    """Recorded transitions, to be trained on with `learner train --task own-data --dataset FILE`.

    Made by `from_arrays` or `from_episodes`; `save` writes the file. `len` is the number of transitions; `repr` is a line,
    `print` shows what is in it and what looks wrong.
    """

    def __init__(self, rows: _Rows) -> None:
        self._rows = rows

    @staticmethod
    def from_arrays(
        *,
        observations: ArrayLike,
        actions: ArrayLike,
        rewards: ArrayLike,
        terminations: ArrayLike,
        truncations: ArrayLike,
        next_observations: ArrayLike | None = None,
    ) -> Dataset:
        """N steps, a row each, in the order of recording.

        observations: [N, o], before each step. actions: [N, a], as applied, in any unit (`learner train --scale actions`
            maps what is outside [-1, 1]). rewards: [N].
        terminations: [N], true where the task itself was over after the step: nothing more is to be gained from there.
        truncations: [N], true where an episode was cut off that could have gone on.
        next_observations: [N, o], after each step and before any reset. Without them the following row's observation
            counts, inside an episode. What followed the last step of a truncated episode is then not known, so that step
            is dropped, as D4RL does it; so is the last row if nothing ends there. After a terminal step nothing counts.

        Raises ValueError for shapes that do not fit one another, for whole numbers as actions, and for NaN, with the row.
        """
        rows = _rows("", observations, actions, rewards, terminations, truncations, next_observations)
        return Dataset(rows if next_observations is not None else _followed(rows))

    @staticmethod
    def from_episodes(episodes: Iterable[Any]) -> Dataset:
        """Episodes, each a dictionary or an object (such as Minari's EpisodeData) with T steps of

        observations: [T + 1, o], the state after the last step included; or [T, o] without it, and then the last step of
            an episode that did not terminate is dropped.
        actions: [T, a]. rewards: [T].
        terminated (or terminations): whether the task was over after the last step; a bool, or [T].
        truncated (or truncations): whether the episode was cut off; a bool, or [T]. An episode that ends without either
            counts as truncated.

        Raises ValueError as `from_arrays`, with the episode, counted from 0.
        """
        parts = [_episode(f"episode {i}: ", episode) for i, episode in enumerate(episodes)]
        if not parts:
            raise ValueError("there is no episode")
        try:
            return Dataset(_Rows(*(np.concatenate(arrays) for arrays in zip(*parts))))
        except ValueError as error:
            raise ValueError(f"all episodes must have observations and actions of the same size: {error}") from None

    def save(self, path: str | PathLike[str]) -> None:
        """Writes an HDF5 file in the layout for own data, once it is whole; one that is there is replaced.

        Raises ValueError with a hint for what training refuses, such as rows without the end of any episode, or a disk that
        does not take it.
        """
        _quad_rl.write_dataset(path, *self._rows)

    def inspect(self) -> dict[str, Any]:
        """What is in it, and what looks wrong: the dictionary of `learner datasets inspect --json`. Raises as `save`."""
        inspection: dict[str, Any] = json.loads(self._inspected()[0])
        return inspection

    def _inspected(self) -> tuple[str, str]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "dataset.hdf5")
            self.save(path)
            json_text, page = _quad_rl.inspect_dataset(path)
        return json_text.replace(str(path), "from arrays"), page.replace(str(path), "from arrays")

    def __len__(self) -> int:
        return len(self._rows.rewards)

    def __repr__(self) -> str:
        o, a = self._rows.observations.shape[1], self._rows.actions.shape[1]
        return f"Dataset({len(self)} transitions, observations of {o} numbers, actions of {a})"

    def __str__(self) -> str:
        return self._inspected()[1]


def _episode(where: str, episode: Any) -> _Rows:
    def of(name: str) -> Any:
        for name in (name, _NAMES.get(name, name)):
            if isinstance(episode, Mapping) and name in episode:
                return episode[name]
            if hasattr(episode, name):
                return getattr(episode, name)
        raise ValueError(f"{where}there are no {name}")

    steps = len(of("rewards"))
    if not steps:
        raise ValueError(f"{where}it has no step")
    ends = []
    for name in _NAMES:
        flags = np.asarray(of(name))
        ends.append(flags if flags.ndim else np.arange(steps) == (steps - 1 if flags else steps))
    observations = np.asarray(of("observations"))
    after = observations[1:] if len(observations) == steps + 1 else None
    rows = _rows(where, observations[:steps], of("actions"), of("rewards"), ends[0], ends[1], after)
    if after is None:
        return _followed(rows)
    rows.timeouts[-1] |= not rows.terminals[-1]
    return rows


def _rows(
    where: str,
    observations: ArrayLike,
    actions: ArrayLike,
    rewards: ArrayLike,
    terminations: ArrayLike,
    truncations: ArrayLike,
    next_observations: ArrayLike | None,
) -> _Rows:
    if np.asarray(actions).dtype.kind in "iub":
        raise ValueError(f"{where}actions are whole numbers, as if they were discrete; only continuous ones can be learnt")
    r = _array(where, "rewards", rewards, None, 1)
    n = len(r)
    o = _array(where, "observations", observations, n, 2)
    return _Rows(
        o,
        _array(where, "actions", actions, n, 2),
        r,
        o if next_observations is None else _array(where, "next_observations", next_observations, n, 2, o.shape[1]),
        _array(where, "terminations", terminations, n, 1) != 0,
        _array(where, "truncations", truncations, n, 1) != 0,
    )


def _array(
    where: str, name: str, values: ArrayLike, rows: int | None, axes: int, width: int | None = None
) -> NDArray[np.float32]:
    """Finite numbers, N or N × width."""
    with np.errstate(over="ignore"):
        array = np.ascontiguousarray(values, dtype=np.float32)
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


def _followed(rows: _Rows) -> _Rows:
    """The same steps with what follows them, without those of which that is not known."""
    o, terminals, timeouts = rows.observations, rows.terminals, rows.timeouts
    after = np.concatenate([o[1:], o[-1:]])
    after[terminals] = o[terminals]  # Not learnt from.
    dropped = timeouts & ~terminals
    dropped[-1:] |= ~terminals[-1:]
    # An episode of which the last step is dropped ends with the one before.
    ends = timeouts & terminals
    ends[:-1] |= dropped[1:] & ~terminals[:-1]
    kept = ~dropped
    return _Rows(o[kept], rows.actions[kept], rows.rewards[kept], after[kept], terminals[kept], ends[kept])
