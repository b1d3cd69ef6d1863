"""The bytes of the landmark index, without an object for each of its entries.

An entry of the message `VIMap` is (protocol buffers, wire format): tag and length; tag and length of the
vertex' id; its two words, each a tag and a varint; the same of the landmark's id.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import U8, U64
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.file_contents import Columns

_PORTION = 1 << 16
"""Entries that are converted at once."""
_VARINT = 10
"""Most bytes of a word."""
_LENGTH_DELIMITED = 2
_ENTRY = pb.LandmarkIndexEntry.DESCRIPTOR.fields_by_name
_ENTRY_TAG = pb.VIMap.DESCRIPTOR.fields_by_name["landmark_index"].number << 3 | _LENGTH_DELIMITED
_ID_TAGS = [_ENTRY[name].number << 3 | _LENGTH_DELIMITED for name in ("vertex_id", "landmark_id")]
_WORD_TAG = pb.Id.DESCRIPTOR.fields_by_name["words"].number << 3


def index_to_bytes(columns: Columns) -> bytes:
    """Return the bytes of the index of landmarks (`landmark_id`) by their vertices (`vertex_id`)."""
    vertex, landmark = columns["vertex_id"], columns["landmark_id"]
    return b"".join(
        _entries(np.stack([vertex[a : a + _PORTION], landmark[a : a + _PORTION]], axis=1))
        for a in range(0, len(landmark), _PORTION)
    )


def _entries(ids: U64) -> bytes:
    """Return the bytes of entries with two ids each (N, 2, 2)."""
    count = len(ids)
    varints, sizes = _varints(ids.byteswap())
    id_size = 2 + sizes.sum(axis=2)  # (N, 2): a tag before each of the words
    table = np.zeros((count, 2, 2 + 2 * (1 + _VARINT)), dtype=np.uint8)
    used = np.zeros(table.shape, dtype=np.bool_)
    table[:, :, 0], table[:, :, 1] = _ID_TAGS, id_size
    words = table[:, :, 2:].reshape(count, 2, 2, 1 + _VARINT)
    words[..., 0], words[..., 1:] = _WORD_TAG, varints
    table[:, :, 2:] = words.reshape(count, 2, -1)
    used[:, :, :2] = True
    places = np.arange(1 + _VARINT)
    used[:, :, 2:] = (places <= sizes[..., None]).reshape(count, 2, -1)
    start = np.empty((count, 2), dtype=np.uint8)
    start[:, 0], start[:, 1] = _ENTRY_TAG, (2 + id_size).sum(axis=1)
    rows = np.concatenate([start, table.reshape(count, -1)], axis=1)
    is_used = np.concatenate([np.ones((count, 2), np.bool_), used.reshape(count, -1)], axis=1)
    return bytes(rows[is_used].data)


def _varints(words: U64) -> tuple[U8, U8]:
    """Return words (...) as varints (..., 10), and the number of bytes (...) of each."""
    shifts = np.arange(0, 7 * _VARINT, 7, dtype=np.uint64)
    rest = words[..., None] >> shifts
    size = np.maximum(np.count_nonzero(rest, axis=-1), 1).astype(np.uint8)
    groups = (rest & np.uint64(0x7F)).astype(np.uint8)
    has_more = np.arange(_VARINT) < size[..., None] - 1
    return groups | has_more.astype(np.uint8) << 7, size
