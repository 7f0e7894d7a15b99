"""A policy's file: its header, and its tensors as arrays."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class File:
    """The file of a policy: `kind`, `shape`, `units`, `chunk` (None for single actions), and tensors as `file[name]`."""

    def __init__(self, data: bytes) -> None:
        start = 8 + int.from_bytes(data[:8], "little")
        listed = json.loads(data[8:start])
        header = json.loads(listed.pop("__metadata__")["quad"])
        self.kind: str = header["policy"]["kind"]
        self.shape: dict[str, Any] = header["policy"]["shape"]
        self.flow_steps: int = header["policy"].get("flow_steps", 0)
        self.chunk: dict[str, int] | None = header.get("chunk")
        # From the user's units to the networks', map by map.
        self.units = [units for units in (header.get("scaling"), self.shape.get("units")) if units]
        self.tensors: dict[str, Array] = {}
        for name, entry in listed.items():
            begin, end = entry["data_offsets"]
            self.tensors[name] = np.frombuffer(data[start + begin : start + end], "<f4").reshape(entry["shape"])

    def __getitem__(self, name: str) -> Array:
        return self.tensors[name]

    def __contains__(self, name: str) -> bool:
        return name in self.tensors
