"""COLMAP's sparse models, binary: cameras.bin, images.bin, points3D.bin.

Source: the format's description in COLMAP's documentation ("Output format"). Integers and numbers are
little-endian; ids count from one; the corner of the first pixel, not its centre, is at 0, 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, U8
from maplab_py.interop.mvs.scene import MvsScene

_PINHOLE = 1
"""Number of COLMAP's camera model with fx, fy, cx, cy."""
_HALF_PIXEL = 0.5


def encode_model(scene: MvsScene) -> dict[str, bytes]:
    """Return the files of a model by their names; every image has its observations in their order."""
    order = np.argsort(scene.view, kind="stable")
    first = np.searchsorted(scene.view[order], np.arange(len(scene.names) + 1))
    return {
        "cameras.bin": _cameras(scene),
        "images.bin": _images(scene, order, first),
        "points3D.bin": _points(scene, order, first),
    }


def _cameras(scene: MvsScene) -> bytes:
    table = np.zeros(
        len(scene.K),
        dtype=[("id", "<u4"), ("model", "<i4"), ("size", "<u8", 2), ("params", "<f8", 4)],
    )
    table["id"], table["model"] = np.arange(1, len(scene.K) + 1), _PINHOLE
    table["size"] = scene.size_px
    table["params"] = scene.K + np.array([0.0, 0.0, _HALF_PIXEL, _HALF_PIXEL])
    return _count(len(table)) + table.tobytes()


def _images(scene: MvsScene, order: I64, first: I64) -> bytes:
    seen = np.zeros(len(order), dtype=[("uv", "<f8", 2), ("point", "<u8")])
    seen["uv"] = scene.uv_px[order] + _HALF_PIXEL
    seen["point"] = scene.landmark[order] + 1
    head = np.zeros(
        len(scene.names),
        dtype=[("id", "<u4"), ("q", "<f8", 4), ("p", "<f8", 3), ("camera", "<u4")],
    )
    head["id"] = np.arange(1, len(scene.names) + 1)
    head["q"] = scene.T_C_G[:, [3, 0, 1, 2]]
    head["p"] = scene.T_C_G[:, 4:]
    head["camera"] = scene.camera + 1
    chunks = [_count(len(head))]
    for row, name in enumerate(scene.names):
        part = seen[first[row] : first[row + 1]]
        chunks += [head[row].tobytes(), name.encode() + b"\0", _count(len(part)), part.tobytes()]
    return b"".join(chunks)


def _points(scene: MvsScene, order: I64, first: I64) -> bytes:
    """Lay out records of unequal length: fixed parts and entries of tracks go to computed places."""
    fixed = np.zeros(
        len(scene.p_G),
        dtype=[
            ("id", "<u8"), ("p", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("track", "<u8"),
        ],
    )  # fmt: skip
    length = np.bincount(scene.landmark, minlength=len(scene.p_G))
    fixed["id"], fixed["p"] = np.arange(1, len(fixed) + 1), scene.p_G
    fixed["colour"], fixed["error"], fixed["track"] = scene.colours, scene.error_px, length
    entry = np.zeros(len(order), dtype=[("image", "<u4"), ("keypoint", "<u4")])
    view = scene.view[order]
    entry["image"], entry["keypoint"] = view + 1, np.arange(len(order)) - first[view]
    by_point = np.argsort(scene.landmark[order], kind="stable")
    sizes = fixed.itemsize + entry.itemsize * length
    start = np.concatenate([[0], np.cumsum(sizes)])
    within = np.arange(len(order)) - np.repeat(np.cumsum(length) - length, length)
    of_entry = np.repeat(start[:-1] + fixed.itemsize, length) + entry.itemsize * within
    data = np.zeros(int(start[-1]), dtype=np.uint8)
    _place(data, start[:-1], fixed)
    _place(data, of_entry, entry[by_point])
    return _count(len(fixed)) + data.tobytes()


def _place(data: U8, at: F64 | I64, rows: NDArray[np.void]) -> None:
    """Copy the bytes of rows to places in an array of bytes."""
    size = rows.dtype.itemsize
    places = at[:, None].astype(np.int64) + np.arange(size)
    data[places] = np.frombuffer(rows.tobytes(), dtype=np.uint8).reshape(len(rows), size)


def _count(number: int) -> bytes:
    return int(number).to_bytes(8, "little")
