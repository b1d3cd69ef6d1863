"""Models in COLMAP's binary format."""

import struct
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import F64
from maplab_py.interop.colmap import model as colmap
from maplab_py.vimap.table import starts_of_counts

_TO_FILE = [3, 0, 1, 2, 4, 5, 6]  # the quaternion's w comes first


def binary_files(model: colmap.ColmapModel) -> dict[str, Iterator[bytes]]:
    """Return the content of the files of a model by name."""
    return {
        "cameras.bin": _encode_cameras(model),
        "rigs.bin": _encode_rigs(model),
        "frames.bin": _encode_frames(model),
        "images.bin": _encode_images(model),
        "points3D.bin": _encode_points(model),
    }


def _encode_cameras(model: colmap.ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.cameras))
    for camera in model.cameras:
        yield struct.pack("<IiQQ", camera.id, camera.model, camera.width_px, camera.height_px)
        yield _doubles(camera.parameters)


def _encode_rigs(model: colmap.ColmapModel) -> Iterator[bytes]:
    yield struct.pack("<Q", len(model.rigs))
    for rig in model.rigs:
        yield struct.pack("<II", rig.id, len(rig.cameras))
        for place, camera in enumerate(rig.cameras):
            yield struct.pack("<iI", colmap.CAMERA_SENSOR, model.cameras[camera].id)
            if place:
                yield b"\x01" + _doubles(rig.T_C_R[place, _TO_FILE])


def _encode_frames(model: colmap.ColmapModel) -> Iterator[bytes]:
    frames, images = model.frames, model.images
    order = np.argsort(images.frame, kind="stable")
    start = starts_of_counts(np.bincount(images.frame, minlength=len(frames.id)))
    yield struct.pack("<Q", len(frames.id))
    for row, (number, rig) in enumerate(zip(frames.id.tolist(), frames.rig.tolist(), strict=True)):
        mine = order[start[row] : start[row + 1]]
        yield struct.pack("<II", number, model.rigs[rig].id) + _doubles(frames.T_R_W[row, _TO_FILE])
        yield struct.pack("<I", len(mine))
        for camera, image in zip(
            images.camera[mine].tolist(), images.id[mine].tolist(), strict=True
        ):
            yield struct.pack("<iIQ", colmap.CAMERA_SENSOR, model.cameras[camera].id, image)


def _encode_images(model: colmap.ColmapModel) -> Iterator[bytes]:
    images = model.images
    keypoints = np.zeros(len(images.uv), dtype=colmap.KEYPOINT)
    keypoints["uv"], keypoints["point"] = images.uv, model.point_id
    start = images.keypoint_start.tolist()
    yield struct.pack("<Q", len(images.id))
    for row, name in enumerate(images.name):
        camera = model.cameras[int(images.camera[row])]
        yield struct.pack("<I", int(images.id[row])) + _doubles(images.T_C_W[row, _TO_FILE])
        yield struct.pack("<I", camera.id) + name.encode() + b"\0"
        yield struct.pack("<Q", start[row + 1] - start[row])
        yield keypoints[start[row] : start[row + 1]].tobytes()


def _encode_points(model: colmap.ColmapModel) -> Iterator[bytes]:
    points, images = model.points, model.images
    observing = np.flatnonzero(images.point >= 0)
    row = images.point[observing]
    length = np.bincount(row, minlength=len(points.id))
    observing = observing[np.argsort(row, kind="stable")]
    records = np.zeros(len(points.id), dtype=colmap.POINT)
    records["id"], records["p_W"], records["colour"] = points.id, points.p_W, points.colour
    records["error"], records["length"] = points.error_px, length
    image = images.keypoint_image[observing]
    elements = np.zeros(len(observing), dtype=colmap.ELEMENT)
    elements["image"] = images.id[image]
    elements["keypoint"] = observing - images.keypoint_start[image]
    start = starts_of_counts(length).tolist()
    yield struct.pack("<Q", len(points.id))
    for number, record in enumerate(records):
        yield record.tobytes() + elements[start[number] : start[number + 1]].tobytes()


def _doubles(values: F64) -> bytes:
    return np.asarray(values, dtype="<f8").tobytes()
