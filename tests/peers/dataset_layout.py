"""Prints shape, type and finiteness of every array of a dataset as JSON, read by h5py."""

import json
import sys

import h5py
import numpy as np

layout = {}


def visit(name, item):
    if isinstance(item, h5py.Dataset) and item.shape:
        values = item[()]
        layout[name] = {
            "shape": list(item.shape),
            "dtype": str(item.dtype),
            "finite": bool(np.isfinite(values).all()) if values.dtype.kind in "fb" else None,
        }


with h5py.File(sys.argv[1]) as file:
    file.visititems(visit)
print(json.dumps(layout))
