"""Optional libraries, by the extra of this package that names them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# What pip has to install for each, as in pyproject.toml, but for versions.
EXTRAS = {
    "gymnasium": ["gymnasium"],
    "lerobot": ["pyarrow"],
    "minari": ["minari[arrow,hdf5,hf]", "pillow"],
    "ogbench": ["ogbench"],
    "onnx": ["onnx"],
    "robomimic": ["h5py"],
    "table": ["pyarrow"],
}


def library(module: str, extra: str) -> Any:
    """A module of an extra. Raises ImportError that names both."""
    with needing(extra):
        return importlib.import_module(module)


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Says of an ImportError within which extra was not installed."""
    try:
        yield
    except ImportError as error:
        packages = " ".join(f"'{package}'" if "[" in package else package for package in EXTRAS[extra])
        hint = f"hint: pip install {packages}, which the extra {extra!r} of quad-rl names"
        raise ImportError(f"{packages.split()[0]} is needed: {error}\n{hint}", name=error.name) from None
