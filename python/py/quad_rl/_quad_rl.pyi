# The types of the compiled module; help() of each class has the rest.
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

class Policy:
    @staticmethod
    def load(path: str | PathLike[str], precision: str = "f32") -> Policy: ...
    @staticmethod
    def from_bytes(file: bytes, precision: str = "f32", name: str = "the file") -> Policy: ...
    def act(
        self,
        observations: ArrayLike | Mapping[str, ArrayLike],
        *,
        candidates: int | None = None,
        rule: str | None = None,
        aggregate: str | None = None,
        guidance: float | None = None,
        seed: int | Sequence[int] | NDArray[np.integer[Any]] | None = None,
    ) -> NDArray[np.float32]: ...
    def sample(
        self,
        observations: ArrayLike | Mapping[str, ArrayLike],
        *,
        candidates: int | None = None,
        aggregate: str | None = None,
        guidance: float | None = None,
        seed: int | Sequence[int] | NDArray[np.integer[Any]] | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
    def value(
        self, observations: ArrayLike | Mapping[str, ArrayLike], actions: ArrayLike | Mapping[str, ArrayLike], *, aggregate: str | None = None
    ) -> NDArray[np.float32]: ...
    def noise(
        self,
        n: int,
        *,
        candidates: int | None = None,
        rule: str | None = None,
        aggregate: str | None = None,
        guidance: float | None = None,
        seed: int | Sequence[int] | NDArray[np.integer[Any]] | None = None,
    ) -> dict[str, NDArray[np.float32]]: ...
    def begin(
        self,
        seeds: int | Sequence[int] | NDArray[np.integer[Any]],
        *,
        candidates: int | None = None,
        rule: str | None = None,
        aggregate: str | None = None,
        guidance: float | None = None,
    ) -> Episodes: ...
    def to_bytes(self) -> bytes: ...
    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    @property
    def observation_names(self) -> list[str]: ...
    @property
    def action_names(self) -> list[str]: ...
    @property
    def environment(self) -> str: ...
    @property
    def step(self) -> int: ...
    @property
    def kind(self) -> str: ...
    @property
    def precision(self) -> str: ...
    @property
    def choice(self) -> dict[str, Any] | None: ...
    @property
    def about(self) -> dict[str, Any]: ...

class Episodes:
    def act(
        self, observations: ArrayLike | Mapping[str, ArrayLike], *, rows: Sequence[int] | NDArray[np.integer[Any]] | None = None
    ) -> NDArray[np.float32]: ...
    def observe(self, observations: ArrayLike | Mapping[str, ArrayLike]) -> None: ...
    def __len__(self) -> int: ...

class Simulation:
    def __init__(self, environment: str, seed: int = 0) -> None: ...
    def reset(self, seed: int) -> None: ...
    def step(self, action: NDArray[np.float32]) -> tuple[float, bool, bool]: ...
    @property
    def observation(self) -> list[float]: ...
    state: tuple[list[float], list[float], list[float] | None]

def write_dataset(
    path: str | PathLike[str],
    observations: NDArray[np.float32],
    actions: NDArray[np.float32],
    rewards: NDArray[np.float32],
    next_observations: NDArray[np.float32],
    terminals: NDArray[np.bool_],
    timeouts: NDArray[np.bool_],
    observation_names: list[str],
    action_names: list[str],
) -> None: ...
def inspect_dataset(path: str | PathLike[str]) -> tuple[str, str]: ...
def benchmark_tasks(benchmark: str) -> list[tuple[str, str, tuple[list[float], float, int] | None]]: ...
def read_run(folder: str | PathLike[str]) -> tuple[str, str]: ...

def serve_environment(
    name: str,
    factory: Any,
    *,
    sizes: tuple[int, int] | None,
    connect: list[str],
    certificates: str | PathLike[str] | None,
    precision: str,
) -> None: ...
def simulated() -> list[str]: ...
