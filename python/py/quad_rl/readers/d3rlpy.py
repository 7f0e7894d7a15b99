"""d3rlpy's datasets in memory."""

from __future__ import annotations

from typing import Any

from quad_rl._rows import Source, rows_from_episodes


def from_d3rlpy(dataset: Any) -> Source:
    """An MDPDataset, or another ReplayBuffer, of d3rlpy 2.

    Steps are those that d3rlpy learns from: an episode is terminal at its last step if it is `terminated`; the last step of
    others is dropped, as what followed it is not stored. Raises ValueError for tuples of observations and for discrete actions.
    """
    episodes = []
    for episode in dataset.episodes:
        if isinstance(episode.observations, (tuple, list)):
            raise ValueError("observations are tuples, but only rows of numbers are learned from")
        arrays = {name: getattr(episode, name) for name in ("observations", "actions", "rewards")}
        episodes.append({**arrays, "terminated": bool(episode.terminated), "truncated": False})
    return Source(rows_from_episodes(episodes))
