"""Compiled walk over the fields of a message."""

from typing import Any

import numpy as np

from maplab_py.compilation import compiled

_DEPTH = 64


@compiled()
def count_parts(data, layout):  # type: ignore[no-untyped-def]
    """Count the messages by type and the numbers in a message; stops where it is damaged.

    Args:
        data: Bytes (N,) of a message of the first type.
        layout: Content (types, 16) of each field: a type, -1 = opaque bytes, -2 = packed varints,
            -3 and -4 = packed numbers of 8 and 4 bytes.

    Returns:
        Messages (types,) below the first one, and numbers.
    """
    messages = np.zeros(layout.shape[0], dtype=np.int64)
    numbers = 0
    end_of = np.zeros(_DEPTH, dtype=np.int64)
    type_of = np.zeros(_DEPTH, dtype=np.int64)
    depth, place = 0, 0
    end_of[0] = len(data)
    while depth >= 0:
        end = end_of[depth]
        if place >= end:
            depth -= 1
            continue
        tag, place = _varint(data, place, end)
        wire = tag & 7
        field = tag >> 3
        if wire == 2:
            size, place = _varint(data, place, end)
            if size < 0 or size > end - place:
                break
            content = layout[type_of[depth], field] if 0 < field < 16 else -1
            if content >= 0:
                messages[content] += 1
                if depth + 1 == _DEPTH:
                    break
                depth += 1
                end_of[depth] = place + size
                type_of[depth] = content
                continue
            if content == -2:
                for k in range(place, place + size):
                    numbers += data[k] < 128
            elif content == -3:
                numbers += size // 8
            elif content == -4:
                numbers += size // 4
            else:
                numbers += 1
            place += size
        else:
            numbers += 1
            if wire == 0:
                _, place = _varint(data, place, end)
            elif wire == 1:
                place += 8
            elif wire == 5:
                place += 4
            elif wire > 5:
                break
    return messages, numbers


@compiled()
def _varint(data, place, end):  # type: ignore[no-untyped-def]
    """Return a varint, truncated to 63 bits, and the position after it; -1 if it is incomplete."""
    value: Any = 0
    shift = 0
    while place < end and shift < 70:
        byte = np.int64(data[place])
        place += 1
        if shift < 63:
            value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            return value & 0x7FFFFFFFFFFFFFFF, place
    return -1, end
