"""The bytes of the landmark index, without an object for each of its entries.

An entry of the message `VIMap` is (protocol buffers, wire format): tag and length; the vertex' id and the
landmark's (see `id_messages`).
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import U64
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.file_contents import Columns
from maplab_py.storage.id_messages import id_rows, tag_of

_PORTION = 1 << 16
"""Entries that are converted at once."""
_ENTRY_TAG = tag_of(pb.VIMap, "landmark_index")
_VERTEX_TAG = tag_of(pb.LandmarkIndexEntry, "vertex_id")
_LANDMARK_TAG = tag_of(pb.LandmarkIndexEntry, "landmark_id")


def index_to_bytes(columns: Columns) -> bytes:
    """Return the bytes of the index of landmarks (`landmark_id`) by their vertices (`vertex_id`)."""
    vertex, landmark = columns["vertex_id"], columns["landmark_id"]
    return b"".join(
        _entries(vertex[a : a + _PORTION], landmark[a : a + _PORTION])
        for a in range(0, len(landmark), _PORTION)
    )


def _entries(vertex: U64, landmark: U64) -> bytes:
    """Return the bytes of entries with two ids (N, 2) each."""
    parts = [id_rows(vertex, _VERTEX_TAG), id_rows(landmark, _LANDMARK_TAG)]
    sizes = [np.count_nonzero(is_used, axis=1) for _, is_used in parts]
    start = np.empty((len(vertex), 2), dtype=np.uint8)
    start[:, 0], start[:, 1] = _ENTRY_TAG, sizes[0] + sizes[1]
    rows = np.concatenate([start, *(part for part, _ in parts)], axis=1)
    used = [np.ones(start.shape, dtype=np.bool_), *(is_used for _, is_used in parts)]
    return bytes(rows[np.concatenate(used, axis=1)].data)
