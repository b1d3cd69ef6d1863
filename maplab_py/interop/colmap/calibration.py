"""The cameras of a COLMAP model: from the folder of a model, or its file of cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.input_files import read_bytes
from maplab_py.interop.colmap.binary import REMEDY, read_binary_cameras
from maplab_py.interop.colmap.model import MODELS, ColmapCamera, ColmapModel, SensorType, map_camera
from maplab_py.interop.colmap.reading import read_model
from maplab_py.sensors import Camera

_FILES = ("cameras.bin", "cameras.txt")
_MAX_BYTES = 100_000_000


def is_colmap(path: Path) -> bool:
    """Return whether a path is the folder of a model, or its file of cameras."""
    return path.name in _FILES or any((path / name).is_file() for name in _FILES)


def read_cameras(path: Path) -> tuple[list[Camera], F64]:
    """Return the cameras of a model, without ids, and their poses (n, 7) on the first one.

    Args:
        path: Folder of a model with one rig, whose poses are taken to be in metres, or a file of one camera.

    Raises:
        UserError: maplab has no such camera model, or it is not known how cameras are mounted.
        MapError: A file cannot be read or is damaged.
    """
    if path.is_dir():
        model = read_model(path)
        cameras, T_R_C = _rig(model, path)
    else:
        cameras = read_binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)
        T_R_C = np.atleast_2d(se3.identity())
        if len(cameras) != 1:
            raise UserError(
                f"{path}: has {len(cameras)} cameras, and does not say how they are mounted: name the "
                "folder of a model with a rig of them"
            )
    return [map_camera(camera, "") for camera in cameras], se3.relative(T_R_C[0], T_R_C)


def _rig(model: ColmapModel, folder: Path) -> tuple[tuple[ColmapCamera, ...], F64]:
    """Return the cameras of a model's rig and their poses T_R_C (n, 7)."""
    if len(model.rigs) != 1:
        raise UserError(
            f"{folder}: has {len(model.rigs)} rigs: a calibration is of one; give a model of one rig, or a "
            "cameras.txt of one camera"
        )
    rig = model.rigs[0]
    by_id = {camera.id: camera for camera in model.cameras}
    mine = [row for row, sensor in enumerate(rig.sensors) if sensor[0] == SensorType.CAMERA]
    T_S_R = rig.T_S_R[mine]
    if not np.isfinite(T_S_R).all():
        raise UserError(f"{folder}: rig {rig.id} has a camera without pose: reconstruct it first")
    return tuple(by_id[rig.sensors[row][1]] for row in mine), se3.inverse(T_S_R)


def _text_cameras(path: Path) -> tuple[ColmapCamera, ...]:
    """Read cameras.txt: lines of id, model, width, height and parameters.

    Raises:
        MapError: It cannot be read, or a line is wrong.
    """
    try:
        data = read_bytes(path, _MAX_BYTES, remedy="it is no file of cameras", error=MapError)
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}; {REMEDY}") from error
    numbers = {model.name: model.number for model in MODELS.values()}
    cameras = []
    for number, line in enumerate(data.decode("utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 4 or words[1] not in numbers:
            raise MapError(
                f"{path}:{number}: wants id, camera model, width, height and parameters; {REMEDY}"
            )
        try:
            camera_id, width, height = int(words[0]), int(words[2]), int(words[3])
            parameters = np.array([float(word) for word in words[4:]])
        except ValueError as error:
            raise MapError(f"{path}:{number}: {error}; {REMEDY}") from None
        model = MODELS[numbers[words[1]]]
        if len(parameters) != model.parameters or not np.isfinite(parameters).all():
            raise MapError(
                f"{path}:{number}: {model.name} has {model.parameters} parameters that are numbers, not "
                f"{len(parameters)}; {REMEDY}"
            )
        if not (0 < width < 1 << 31 and 0 < height < 1 << 31):
            raise MapError(f"{path}:{number}: the images have no pixels; {REMEDY}")
        cameras.append(ColmapCamera(camera_id, model.number, width, height, parameters))
    return tuple(cameras)
