"""Columns of Arrow tables as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._extras import library


def to_array(column: Any, name: str, place: str) -> NDArray[Any]:
    """A column of pyarrow's: N numbers or texts, or N rows of lists that are all of the same length.

    place: what errors call the table. Raises ValueError for an empty place and for lists of several lengths.
    """
    pa = library("pyarrow", "lerobot")
    array, shape = column, [len(column)]
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], array.type)
    while True:
        if array.null_count:
            row = int(np.flatnonzero(array.is_null().to_numpy(zero_copy_only=False))[0]) // max(1, int(np.prod(shape[1:])))
            raise ValueError(f"{place}: column {name!r}, row {row} is empty ({array.null_count} such numbers)")
        if isinstance(array, pa.ExtensionArray):
            array = array.storage
        elif pa.types.is_dictionary(array.type):
            array = array.dictionary_decode()
        elif pa.types.is_decimal(array.type):
            array = array.cast(pa.float64())
        elif pa.types.is_list(array.type) or pa.types.is_large_list(array.type) or pa.types.is_fixed_size_list(array.type):
            inner = array.flatten()
            each = len(inner) // max(1, len(array))
            lengths = library("pyarrow.compute", "lerobot").list_value_length(array).to_numpy(zero_copy_only=False)
            if (lengths != each).any():
                raise ValueError(f"{place}: column {name!r} has lists of several lengths, {lengths.min()} to {lengths.max()}")
            array, shape = inner, [*shape, each]
        else:
            values: NDArray[Any] = array.to_numpy(zero_copy_only=False)
            return values.reshape(shape)
