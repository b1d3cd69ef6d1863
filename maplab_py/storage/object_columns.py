"""Columns of Python objects as columns of numbers: distinct values, and which of them each row has.

Two kinds of objects are known: bytes (unknown fields) and descriptor blocks of frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.vimap.descriptors import DescriptorBlock
from maplab_py.vimap.table import object_column, ragged_rows, starts_of_counts

_NONE = -1
"""Length of the value None."""
_BLOCK_WIDTH = len(DescriptorBlock._fields)

Parts = dict[str, NDArray[Any]]
"""`index` (N,) into D distinct values, `length` (D,) of each, and `items` of all of them."""


def encoded(values: Sequence[Any]) -> Parts:
    """Return the parts of a column (N,) of bytes, or of tuples of descriptor blocks or None."""
    place = {value: at for at, value in enumerate(dict.fromkeys(values))}
    items: NDArray[Any]
    index = np.fromiter(map(place.__getitem__, values), np.int32, len(values))
    length = [_NONE if value is None else len(value) for value in place]
    if all(isinstance(value, bytes) for value in place):
        items = np.frombuffer(b"".join(place), dtype=np.uint8)
    else:
        blocks = [tuple(block) for value in place for block in value or ()]
        items = np.array(blocks, dtype=np.int64).reshape(-1, _BLOCK_WIDTH)
    return {"index": index, "length": np.array(length, dtype=np.int64), "items": items}


def decoded(parts: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Return the column (N,).

    Raises:
        ValueError: The parts do not fit each other.
    """
    index, length, items = parts["index"], parts["length"], parts["items"]
    count = np.maximum(length, 0)
    start = starts_of_counts(count)
    if int(start[-1]) != len(items) or (
        len(index) and not 0 <= index.min() <= index.max() < len(length)
    ):
        raise ValueError("the values of a column of objects do not fit their lengths")
    if items.ndim == 1:
        data = items.tobytes()
        values: list[Any] = [data[a:b] for a, b in pairwise(start)]
    else:
        blocks = [
            DescriptorBlock(*row)
            for row in items[ragged_rows(start, np.arange(len(count)))].tolist()
        ]
        values = [
            None if size == _NONE else tuple(blocks[first : first + size])
            for first, size in zip(start[:-1].tolist(), length.tolist(), strict=True)
        ]
    return np.asarray(object_column(values)[index])
