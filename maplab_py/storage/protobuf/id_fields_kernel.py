"""Compiled reading of ids from the bytes of messages.

An object per id takes ten times as long as its two numbers; maps have millions of them.
"""

from typing import Any

import numpy as np

from maplab_py.compilation import compiled

_WORDS_FIELD = 1


@compiled()
def read_ids(data, begin, end_of, field, count):  # type: ignore[no-untyped-def]
    """Return the ids (count, 2) in a field of messages.

    Args:
        data: Bytes (N,) with M valid messages.
        begin: First byte (M,) of every message.
        end_of: Byte (M,) after every message.
        field: Number of the field.
        count: Number of ids.

    Returns:
        The ids, zero where an id has no words; and whether every id has two words or none, and there
        are as many as said.
    """
    ids = np.zeros((count, 2), dtype=np.uint64)
    row, is_regular = 0, True
    for message in range(len(begin)):
        place, end = begin[message], end_of[message]
        while place < end:
            tag, place = _varint(data, place, end)
            wire = tag & np.uint64(7)
            if wire == 2:
                size, place = _varint(data, place, end)
                if tag >> np.uint64(3) == field:
                    if row == count:
                        return ids, False
                    is_regular &= _read_words(data, place, place + np.int64(size), ids[row])
                    row += 1
                place += np.int64(size)
            elif wire == 0:
                _, place = _varint(data, place, end)
            elif wire == 1:
                place += 8
            elif wire == 5:
                place += 4
            else:
                return ids, False
    return ids, is_regular and row == count


@compiled()
def parts_of_field(data, field):  # type: ignore[no-untyped-def]
    """Return first byte and byte after (M,) of the parts of a message in a repeated field.

    Args:
        data: Bytes (N,) of a message.
        field: Number of the field.

    Returns:
        The parts; and whether the message holds nothing else, no part is empty, and none truncated.
    """
    count, begin, end = 0, np.empty(0, np.int64), np.empty(0, np.int64)
    for is_counting in (True, False):
        place, row = np.int64(0), 0
        while place < len(data):
            tag, place = _varint(data, place, len(data))
            size, place = _varint(data, place, len(data))
            is_part = tag == np.uint64(8 * field + 2) and size > np.uint64(0)
            if not is_part or size > np.uint64(len(data) - place):
                return begin, end, False
            if not is_counting:
                begin[row], end[row] = place, place + np.int64(size)
            row += 1
            place += np.int64(size)
        if is_counting:
            count = row
            begin, end = np.empty(count, np.int64), np.empty(count, np.int64)
    return begin, end, True


@compiled()
def _read_words(data, place, end, words):  # type: ignore[no-untyped-def]
    """Read the words (2,) of one id; tell whether there are two or none."""
    count = 0
    while place < end:
        tag, place = _varint(data, place, end)
        wire, stop = tag & np.uint64(7), place
        if tag >> np.uint64(3) != _WORDS_FIELD or (wire != 0 and wire != 2):
            return False
        if wire == 2:
            size, place = _varint(data, place, end)
            stop = place + np.int64(size)
        while True:
            if wire == 2 and place >= stop:
                break
            value, place = _varint(data, place, end)
            if count < 2:
                words[count] = value
            count += 1
            if wire == 0:
                break
    return count == 2 or count == 0


@compiled()
def _varint(data, place, end):  # type: ignore[no-untyped-def]
    """Return a varint and the position after it."""
    value: Any = np.uint64(0)
    shift = np.uint64(0)
    while place < end:
        byte = np.uint64(data[place])
        place += 1
        value |= (byte & np.uint64(127)) << shift
        shift += np.uint64(7)
        if byte < 128:
            break
    return value, place
