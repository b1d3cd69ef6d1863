"""Write a model in COLMAP's binary format: keypoints, points and tracks as whole columns."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import F64, U8
from maplab_py.interop.colmap.model import ColmapModel, SensorType
from maplab_py.interop.colmap.point_scan_kernel import ELEMENT_BYTES, RECORD_BYTES
from maplab_py.vimap.table import starts_of_counts

KEYPOINT = np.dtype([("uv", "<f8", 2), ("point", "<i8")])
POINT = np.dtype(
    [("id", "<i8"), ("p_W", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("length", "<i8")]
)
ELEMENT = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
_TO_FILE = [3, 0, 1, 2, 4, 5, 6]  # the quaternion's w comes first


def binary_files(model: ColmapModel) -> dict[str, Iterator[bytes]]:
    """Return the content of the files of a model by name."""
    return {
        "cameras.bin": _cameras(model),
        "rigs.bin": _rigs(model),
        "frames.bin": _frames(model),
        "images.bin": _images(model),
        "points3D.bin": _points(model),
    }


def _cameras(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.cameras))
    for camera in model.cameras:
        yield struct.pack("<IiQQ", camera.id, camera.model, camera.width_px, camera.height_px)
        yield _doubles(camera.parameters)


def _rigs(model: ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.rigs))
    for rig in model.rigs:
        yield struct.pack("<II", rig.id, len(rig.sensors))
        for row, sensor in enumerate(rig.sensors):
            yield struct.pack("<iI", *sensor)
            if row:
                yield b"\x01" + _doubles(rig.T_S_R[row, _TO_FILE])


def _frames(model: ColmapModel) -> Iterator[bytes]:
    frames = model.frames
    order = np.argsort(frames.image_frame, kind="stable")
    images = frames.image_id[order]
    start = starts_of_counts(np.bincount(frames.image_frame, minlength=len(frames.id)))
    row_of_image = {image: row for row, image in enumerate(model.images.id.tolist())}
    yield struct.pack("<Q", len(frames.id))
    for row, (number, rig) in enumerate(zip(frames.id.tolist(), frames.rig.tolist(), strict=True)):
        mine = images[start[row] : start[row + 1]].tolist()
        yield struct.pack("<II", number, rig) + _doubles(frames.T_R_W[row, _TO_FILE])
        yield struct.pack("<I", len(mine))
        for image in mine:
            camera = int(model.images.camera[row_of_image[image]])
            yield struct.pack("<iIQ", SensorType.CAMERA, camera, image)


def _images(model: ColmapModel) -> Iterator[bytes]:
    images = model.images
    keypoints = np.zeros(len(images.uv), dtype=KEYPOINT)
    keypoints["uv"], keypoints["point"] = images.uv, images.point
    start = images.keypoint_start.tolist()
    yield struct.pack("<Q", len(images.id))
    for row, name in enumerate(images.name):
        yield struct.pack("<I", int(images.id[row])) + _doubles(images.T_C_W[row, _TO_FILE])
        yield struct.pack("<I", int(images.camera[row])) + name.encode() + b"\0"
        yield struct.pack("<Q", start[row + 1] - start[row])
        yield keypoints[start[row] : start[row + 1]].tobytes()


def _points(model: ColmapModel) -> Iterator[bytes]:
    """Yield the records as bytes that are scattered to their places."""
    points, images = model.points, model.images
    observing = np.flatnonzero(images.point >= 0)
    order = np.argsort(points.id, kind="stable")
    row = order[np.searchsorted(points.id[order], images.point[observing])]
    length = np.bincount(row, minlength=len(points.id))
    by_point = np.argsort(row, kind="stable")
    observing, row = observing[by_point], row[by_point]
    records = np.zeros(len(points.id), dtype=POINT)
    records["id"], records["p_W"], records["colour"] = points.id, points.p_W, points.colour
    records["error"], records["length"] = points.error_px, length
    image = images.keypoint_image[observing]
    elements = np.zeros(len(observing), dtype=ELEMENT)
    elements["image"] = images.id[image]
    elements["keypoint"] = observing - images.keypoint_start[image]
    start = starts_of_counts(RECORD_BYTES + ELEMENT_BYTES * length)
    data: U8 = np.zeros(int(start[-1]), dtype=np.uint8)
    data[start[:-1, None] + np.arange(RECORD_BYTES)] = _bytes(records, RECORD_BYTES)
    of_point = np.arange(len(observing)) - starts_of_counts(length)[row]
    place = start[row] + RECORD_BYTES + ELEMENT_BYTES * of_point
    data[place[:, None] + np.arange(ELEMENT_BYTES)] = _bytes(elements, ELEMENT_BYTES)
    yield struct.pack("<Q", len(points.id))
    yield data.tobytes()


def _bytes(records: np.ndarray, size: int) -> U8:
    """Return records (N,) as bytes (N, size)."""
    return records.view(np.uint8).reshape(len(records), size)


def _doubles(values: F64) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()
