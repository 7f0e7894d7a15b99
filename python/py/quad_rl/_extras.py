"""Optional libraries, by the extra of this package that installs them."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# The packages of each extra, as in pyproject.toml, without versions.
EXTRAS = {
    "gymnasium": ["gymnasium"],
    "lerobot": ["pyarrow"],
    "minari": ["minari[arrow,hdf5,hf]", "pillow"],
    "ogbench": ["ogbench"],
    "onnx": ["onnx"],
    "robomimic": ["h5py"],
    "table": ["pyarrow"],
    "video": ["av"],
}


def library(module: str, extra: str) -> Any:
    """Imports a module of an extra. The ImportError names both."""
    with needing(extra):
        return importlib.import_module(module)


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Names the missing extra in an ImportError."""
    try:
        yield
    except ImportError as error:
        packages = " ".join(f"'{package}'" if "[" in package else package for package in EXTRAS[extra])
        hint = f"hint: pip install {packages} (the extra {extra!r} of quad-rl)"
        raise ImportError(f"{packages.split()[0]} is needed: {error}\n{hint}", name=error.name) from None
