"""The bytes of repeated fields of ids, without an object for each of them.

An id is a message with two words. In a repeated field (protocol buffers, wire format) it is the field's tag
and its length, and for each word a tag and a varint.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from google.protobuf.message import Message

from maplab_py.array_types import I64, U8, U64, Mask
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.vimap.table import starts_of_counts

_VARINT = 10
"""Most bytes of a word."""
_LENGTH_DELIMITED = 2
_SHORT_TAGS = 128
_WORD = 1 + _VARINT
_ROW = 2 + 2 * _WORD
_WORD_TAG = pb.Id.DESCRIPTOR.fields_by_name["words"].number << 3


@dataclasses.dataclass(frozen=True)
class IdFields:
    """The bytes of ids in a repeated field.

    Attributes:
        data: The bytes of all of them.
        start: Offsets (N + 1) into them.
    """

    data: bytes
    start: list[int]

    def of(self, rows: slice) -> bytes:
        """Return the bytes of consecutive ids."""
        return self.data[self.start[rows.start] : self.start[rows.stop]]


def tag_of(message: type[Message], name: str) -> int:
    """Return the tag of a message's field of messages; ValueError where it takes more than a byte."""
    tag = int(message.DESCRIPTOR.fields_by_name[name].number) << 3 | _LENGTH_DELIMITED
    if tag >= _SHORT_TAGS:
        raise ValueError(f"the tag of {name} takes more than a byte")
    return tag


def id_fields(ids: U64, tag: int) -> IdFields:
    """Return ids (N, 2) as elements of a repeated field with a tag."""
    rows, is_used = id_rows(ids, tag)
    start: I64 = starts_of_counts(np.count_nonzero(is_used, axis=1))
    return IdFields(rows[is_used].tobytes(), start.tolist())


def id_rows(ids: U64, tag: int) -> tuple[U8, Mask]:
    """Return ids (N, 2) as bytes (N, 24), and which of them are used.

    Args:
        ids: The ids.
        tag: Tag of the field that has them.
    """
    varints, sizes = _varints(ids.byteswap())
    rows = np.empty((len(ids), _ROW), dtype=np.uint8)
    is_used = np.ones(rows.shape, dtype=np.bool_)
    rows[:, 0], rows[:, 1] = tag, 2 + sizes.sum(axis=1)
    for word, first in enumerate((2, 2 + _WORD)):
        rows[:, first], rows[:, first + 1 : first + _WORD] = _WORD_TAG, varints[:, word]
        is_used[:, first + 1 : first + _WORD] = np.arange(_VARINT) < sizes[:, word, None]
    return rows, is_used


def _varints(words: U64) -> tuple[U8, U8]:
    """Return words (...) as varints (..., 10), and the number of bytes (...) of each."""
    shifts = np.arange(0, 7 * _VARINT, 7, dtype=np.uint64)
    rest = words[..., None] >> shifts
    size = np.maximum(np.count_nonzero(rest, axis=-1), 1).astype(np.uint8)
    groups = (rest & np.uint64(0x7F)).astype(np.uint8)
    has_more = np.arange(_VARINT) < size[..., None] - 1
    return groups | has_more.astype(np.uint8) << 7, size
