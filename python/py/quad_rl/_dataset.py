"""Data from arrays, and from other programs' files."""

from __future__ import annotations

import functools
import inspect
import json
import tempfile
from collections.abc import Callable, Iterable
from os import PathLike
from pathlib import Path
from typing import Any, ParamSpec

from numpy.typing import ArrayLike

from quad_rl import _quad_rl
from quad_rl._rows import Rows, Source, followed, rows_from_arrays, rows_from_episodes
from quad_rl.readers import d3rlpy, frame, lerobot, minari, ogbench, robomimic

P = ParamSpec("P")


def _dataset_by(read: Callable[P, Source]) -> Callable[P, Dataset]:
    """The function of a reader, with a `Dataset` as its result."""

    @functools.wraps(read)
    def made(*args: P.args, **kwargs: P.kwargs) -> Dataset:
        return Dataset(*read(*args, **kwargs))

    made.__signature__ = inspect.signature(read).replace(return_annotation="Dataset")  # type: ignore[attr-defined]
    return made


class Dataset:
    """Recorded transitions, to be trained on with `learner train --task own-data --dataset FILE`.

    Made by one of the functions `from_…`; `save` writes the file. `len` is the number of transitions; `print` shows
    statistics, problems and `notes`.
    """

    from_d3rlpy = staticmethod(_dataset_by(d3rlpy.from_d3rlpy))
    from_frame = staticmethod(_dataset_by(frame.from_frame))
    from_lerobot = staticmethod(_dataset_by(lerobot.from_lerobot))
    from_minari = staticmethod(_dataset_by(minari.from_minari))
    from_ogbench = staticmethod(_dataset_by(ogbench.from_ogbench))
    from_robomimic = staticmethod(_dataset_by(robomimic.from_robomimic))

    def __init__(
        self, rows: Rows, names: tuple[list[str], list[str]] = ([], []), notes: Iterable[str] = ()
    ) -> None:
        self._rows = rows
        self._names = names
        self._notes = list(notes)

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

        observations: [N, o], before each step. actions: [N, a], as applied, in any unit (`learner train --normalize actions`
            maps what is outside [-1, 1]). rewards: [N].
        terminations: [N], true where the task itself was over after the step: nothing more is to be gained from there.
        truncations: [N], true where an episode was cut off that could have gone on.
        next_observations: [N, o], after each step and before any reset. Without them the following row's observation
            counts, inside an episode. What followed the last step of a truncated episode is then not known, so that step
            is dropped, as D4RL does it; so is the last row if nothing ends there. After a terminal step nothing counts.

        Raises ValueError for shapes that do not fit one another, for whole numbers as actions, and, with the row, for NaN, numbers
        that a masked array hides, and flags that are neither 0 nor 1.
        """
        rows = rows_from_arrays("", observations, actions, rewards, terminations, truncations, next_observations)
        return Dataset(rows if next_observations is not None else followed(rows))

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
        return Dataset(rows_from_episodes(episodes))

    def save(self, path: str | PathLike[str]) -> None:
        """Writes an HDF5 file in the layout for own data, once it is whole; one that is there is replaced.

        Raises ValueError with a hint for what training refuses, such as rows without the end of any episode, or a disk that
        does not take it.
        """
        _quad_rl.write_dataset(path, *self._rows, *self._names)

    def inspect(self) -> dict[str, Any]:
        """Statistics and problems: the dictionary of `learner datasets inspect --json`. Raises as `save`."""
        inspection: dict[str, Any] = json.loads(self._inspected()[0])
        return inspection

    def _inspected(self) -> tuple[str, str]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "dataset.hdf5")
            self.save(path)
            json_text, page = _quad_rl.inspect_dataset(path)
        return json_text.replace(str(path), "in memory"), page.replace(str(path), "in memory")

    @property
    def notes(self) -> list[str]:
        """Notes on reading the source, such as what was left out, a sentence each."""
        return list(self._notes)

    @property
    def observation_names(self) -> list[str]:
        """The source's names of the numbers of an observation, also in the file and the policy; empty if it has none."""
        return list(self._names[0])

    @property
    def action_names(self) -> list[str]:
        """The source's names of the numbers of an action."""
        return list(self._names[1])

    def __len__(self) -> int:
        return len(self._rows.rewards)

    def __repr__(self) -> str:
        o, a = self._rows.observations.shape[1], self._rows.actions.shape[1]
        return f"Dataset({len(self)} transitions, observations of {o} numbers, actions of {a})"

    def __str__(self) -> str:
        page = self._inspected()[1]
        return page + "".join(["\n\nas it was read" if self._notes else "", *(f"\n  - {note}" for note in self._notes)])
