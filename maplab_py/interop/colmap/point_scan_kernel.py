"""Compiled walk over the records of points3D.bin, whose lengths differ."""

from __future__ import annotations

import numpy as np

from maplab_py.compilation import compiled

RECORD_BYTES = 51
"""Bytes of a point without its track: id, position, colour, error, length of the track."""
ELEMENT_BYTES = 8
"""Bytes of an element of a track: image and keypoint."""
_LENGTH_AT = 43


@compiled()
def record_starts(data, first, count):  # type: ignore[no-untyped-def]
    """Return where the records of points begin.

    Args:
        data: Bytes (N,) of the file.
        first: Place of the first record.
        count: Number of records.

    Returns:
        Places (count + 1,) of the records and of their end; -1 from the record on that is not
        complete.
    """
    starts = np.full(count + 1, -1, dtype=np.int64)
    place = first
    for row in range(count):
        if place + RECORD_BYTES > len(data):
            return starts
        length = np.int64(0)
        for byte in range(8):
            length |= np.int64(data[place + _LENGTH_AT + byte]) << np.int64(8 * byte)
        if length < 0 or length > (len(data) - place - RECORD_BYTES) // ELEMENT_BYTES:
            return starts
        starts[row] = place
        place += RECORD_BYTES + ELEMENT_BYTES * length
    starts[count] = place
    return starts


def compile_kernels() -> None:
    """Compile the kernel of this module."""
    record_starts(np.zeros(RECORD_BYTES, dtype=np.uint8), 0, 1)
