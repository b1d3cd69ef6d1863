"""Compiled reading of ids and landmarks from the bytes of messages.

An object per id takes ten times as long as its two numbers; maps have millions of them.
"""

from typing import Any

import numpy as np

from maplab_py.compilation import compiled

_WORDS_FIELD = 1
_NOT_A_NUMBER = np.array([np.nan]).view(np.uint64)[0]


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
def landmark_columns(data, begin, end):  # type: ignore[no-untyped-def]
    """Return the fields of landmarks.

    Args:
        data: Bytes (N,) with L valid messages.
        begin: First byte (L,) of every message.
        end: Byte (L,) after every message.

    Returns:
        Id (L, 2), bits of position and covariance (L, 12; without one it is not a number), quality and
        type (L, 2), lengths (L, 3) of the lists of observers, keypoints and frames, ids (O, 2) of
        observers, numbers (2, O) of keypoints and frames; and whether all is regular: there are no other
        fields, the lists of a landmark are of the same length, and others have all entries or none.
    """
    count = len(begin)
    ids, numbers = np.zeros((count, 2), np.uint64), np.zeros((count, 12), np.uint64)
    numbers[:, 3:] = _NOT_A_NUMBER
    kinds, lengths = np.zeros((count, 2), np.int64), np.zeros((count, 3), np.int64)
    observers, indices = np.zeros((0, 2), np.uint64), np.zeros((2, 0), np.int64)
    unused, is_regular = np.zeros(2, np.uint64), True
    for is_counting in (True, False):
        total = lengths[:, 0].sum()
        if not is_counting:
            observers, indices = np.zeros((total, 2), np.uint64), np.zeros((2, total), np.int64)
        first, length, size = 0, np.zeros(3, np.int64), np.zeros(2, np.int64)
        for landmark in range(count if is_regular else 0):
            place, length[:], size[:] = begin[landmark], 0, 0
            while place < end[landmark]:
                tag, place = _varint(data, place, end[landmark])
                field, wire = np.int64(tag >> np.uint64(3)), tag & np.uint64(7)
                if wire == 1 and (field == 2 or field == 3):
                    if size[field - 2] < (3 if field == 2 else 9):
                        column = (0 if field == 2 else 3) + size[field - 2]
                        numbers[landmark, column] = _fixed(data, place)
                    size[field - 2] += 1
                    place += 8
                    continue
                value, place = _varint(data, place, end[landmark])  # of a number, or the size
                if wire == 0 and (field == 7 or field == 9):
                    kinds[landmark, (field - 7) // 2] = np.int64(value)
                elif wire == 0 and (field == 5 or field == 6):
                    if not is_counting:
                        indices[field - 5, first + length[field - 4]] = np.int64(value)
                    length[field - 4] += 1
                elif wire == 2 and (field == 1 or field == 4):
                    words = ids[landmark]
                    if field == 4:
                        words = unused if is_counting else observers[first + length[0]]
                        length[0] += 1
                    stop = place + np.int64(value)
                    is_regular &= _read_words(data, place, stop, words)
                    place = stop
                else:
                    return ids, numbers, kinds, lengths, observers, indices, False
            lengths[landmark] = length
            first += length[0]
            is_regular &= length[0] == length[1] and length[0] == length[2]
            is_regular &= (size[0] == 0 or size[0] == 3) and (size[1] == 0 or size[1] == 9)
    return ids, numbers, kinds, lengths, observers, indices, is_regular


@compiled()
def _fixed(data, place):  # type: ignore[no-untyped-def]
    """Return a number of eight bytes."""
    value: Any = np.uint64(0)
    for k in range(8):
        value |= np.uint64(data[place + k]) << np.uint64(8 * k)
    return value


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
