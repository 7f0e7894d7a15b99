"""Videos as numbers, by a function of the user's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quad_rl._extras import library

Encoder = Callable[[NDArray[np.uint8]], ArrayLike]  # Frames [n, h, w, 3] to [n, k].
_BATCH = 64  # Frames.


def column(feature: str, encoder: Encoder) -> str:
    """The column of an encoder's numbers."""
    return f"{feature}.{getattr(encoder, '__name__', type(encoder).__name__)}"


def encoded(name: str, encoder: Encoder, path: Path, times: NDArray[np.float64], interval: float) -> NDArray[Any]:
    """Numbers [N, k] of a video's frames at N ascending times, which are `interval` apart, in seconds.

    Raises ValueError where there is no frame, and for numbers of another shape, which it calls `name`.
    """
    parts, frames = [], _frames(path, times.tolist(), interval)
    while batch := list(islice(frames, _BATCH)):
        numbers = np.asarray(encoder(np.stack(batch)))
        if numbers.ndim != 2 or len(numbers) != len(batch):
            raise ValueError(f"{name} has shape {list(numbers.shape)} for {len(batch)} frames, but must have [{len(batch)}, k]")
        parts.append(numbers)
    return np.concatenate(parts)


def _frames(path: Path, times: list[float], interval: float) -> Iterator[NDArray[np.uint8]]:
    with library("av", "video").open(str(path)) as video:
        stream = video.streams.video[0]
        video.seek(int(times[0] / stream.time_base), stream=stream)  # To the key frame before it.
        for frame in video.decode(stream):
            if frame.time > times[0] + interval / 2:
                break
            if frame.time >= times[0] - interval / 2:
                yield frame.to_ndarray(format="rgb24")
                del times[0]
                if not times:
                    return
    raise ValueError(f"{path}: there is no frame at {times[0]:.3f} s")
