"""HDF5 files that hold all of their numbers themselves."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import Any

from quad_rl._extras import library


@contextmanager
def opened(path: str | PathLike[str], extra: str) -> Iterator[Any]:
    """A file of h5py's, to be read; all of the package opens HDF5 files here.

    extra: the one that h5py is of. Raises ValueError for a file of which an array lies in another one, as HDF5's external links,
    external storage and virtual arrays have it: reading it would put numbers of any file of this machine into a dataset.
    """
    h5py = library("h5py", extra)
    with h5py.File(path, "r") as file:
        name = _elsewhere(h5py, file, {h5py.h5o.get_info(file.id).addr})
        if name is not None:
            hint = "hint: if you trust who made the file, copy its arrays into one file, by h5py's new[name] = old[name][()]"
            raise ValueError(f"{path}: {name} is not in this file: it leads to numbers that lie elsewhere\n{hint}")
        yield file


def _elsewhere(h5py: Any, group: Any, seen: set[int]) -> str | None:
    """The first name that leads out of the file."""
    for name in group:
        link = group.get(name, getlink=True)
        if isinstance(link, h5py.SoftLink):
            continue  # To a name in this file, which has its own turn.
        if isinstance(link, h5py.ExternalLink):
            return f"{group.name}/{name}".replace("//", "/")
        one = group[name]
        if isinstance(one, h5py.Dataset):
            creation = one.id.get_create_plist()
            if creation.get_layout() == h5py.h5d.VIRTUAL or creation.get_external_count():
                return str(one.name)
        elif isinstance(one, h5py.Group) and (address := h5py.h5o.get_info(one.id).addr) not in seen:
            seen.add(address)
            elsewhere = _elsewhere(h5py, one, seen)
            if elsewhere is not None:
                return elsewhere
    return None
