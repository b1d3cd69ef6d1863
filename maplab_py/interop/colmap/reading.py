"""Read the model of a folder, in either format, and check the references within it."""

import dataclasses
import struct
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.colmap import model as colmap
from maplab_py.interop.colmap.records import ANNOUNCED, FILES_OF, REMEDY, Records
from maplab_py.sensors import Camera

_HEADER_BYTES = 4096
_NEEDED = ("cameras", "images", "points3D")
_CAMERA_MODELS = {model.name: model.number for model in colmap.MODELS.values()}
_SENSORS = {"CAMERA": colmap.CAMERA_SENSOR, "IMU": 1}


def read_model(folder: Path) -> colmap.ColmapModel:
    """Read and check a model; binary files come before text files, as in COLMAP.

    Raises:
        UserError: The folder has no model.
        MapError: A file is missing, damaged, or does not fit the others.
    """
    if not folder.is_dir():
        raise UserError(f"--colmap_folder={folder}: no such folder")
    if (folder / "images.bin").exists() or (folder / "cameras.bin").exists():
        model = _read_files(folder, ".bin")
    elif (folder / "images.txt").exists():
        model = _read_files(folder, ".txt")
    else:
        raise UserError(
            f"--colmap_folder={folder}: has no COLMAP model (cameras, images, points3D as .bin or .txt)"
            f"{_models_below(folder)}"
        )
    return model


def _models_below(folder: Path) -> str:
    """Return a clause on the models in folders below, with what they have; empty without any."""
    models: list[tuple[int, str]] = []
    for path in sorted([*folder.glob("*/"), *folder.glob("sparse/*/")]):
        by_suffix = [[path / f"{kind}{suffix}" for kind in _NEEDED] for suffix in (".bin", ".txt")]
        files = next((files for files in by_suffix if any(f.is_file() for f in files)), [])
        missing = [file.name for file in files if not file.is_file()]
        if files:
            images, points = (_count(file) for file in files[1:])
            said = (
                f"incomplete: no {', '.join(missing)}"
                if missing
                else f"{images} images, {points} points"
            )
            number = int(images) if images.isdecimal() and not missing else 0
            models.append((number, f"{path.relative_to(folder).as_posix()} ({said})"))
    if not models:
        return ""
    models.sort(key=lambda model: -model[0])
    largest = f"; the largest is {folder / models[0][1].split(' (')[0]}" if models[0][0] else ""
    return f"; it has models in {', '.join(text for _, text in models)}{largest}"


def _count(path: Path) -> str:
    """Return the number of records that a file announces, ? where it does not."""
    try:
        if path.suffix == ".txt":
            with path.open(encoding="utf-8", errors="replace") as stream:
                announced = ANNOUNCED.search(stream.read(_HEADER_BYTES))
            return "?" if announced is None else announced[1]
        with path.open("rb") as binary:
            return str(*struct.unpack("<Q", binary.read(8)))
    except (OSError, struct.error):
        return "?"


def _read_files(folder: Path, suffix: str) -> colmap.ColmapModel:
    """Read the files of a model: check that ids are unique, and replace references to them by rows.

    Models of versions without rigs and frames get a rig of each camera, and a frame of each image.
    """
    opened = FILES_OF[suffix]
    cameras = _cameras(opened(folder / f"cameras{suffix}"))
    images = _images(opened(folder / f"images{suffix}"))
    points = _points(opened(folder / f"points3D{suffix}"))
    rigs_file, frames_file = (folder / f"{kind}{suffix}" for kind in ("rigs", "frames"))
    if rigs_file.exists() or frames_file.exists():
        rigs, (frames, owner, image) = (
            _rigs(opened(rigs_file)),
            _frames(opened(frames_file)),
        )
    else:
        used = np.unique(images.camera).tolist()
        rigs = tuple(colmap.ColmapRig(number, (number,), se3.identity(1)) for number in used)
        frames = colmap.ColmapFrames(images.id, images.camera, images.T_C_W)
        owner, image = np.arange(len(images.id)), images.id
    if not len(images.id):
        raise MapError(f"{folder}: the model has no images with a pose: nothing can be imported")
    camera_ids, rig_ids, mounted = (
        np.array(list(numbers), dtype=np.int64)
        for numbers in (
            (camera.id for camera in cameras),
            (rig.id for rig in rigs),
            (number for rig in rigs for number in rig.cameras),
        )
    )
    for noun, ids in (
        ("camera", camera_ids),
        ("rig", rig_ids),
        ("camera in a rig", mounted),
        ("frame", frames.id),
        ("image", images.id),
        ("image in a frame", image),
        ("point", points.id),
    ):
        values, counts = np.unique(ids, return_counts=True)
        _refuse(folder, f"{noun} {{}} is there twice", values, counts > 1)
    names, counts = np.unique(np.array(images.name), return_counts=True)
    if np.any(counts > 1):
        raise MapError(
            f"{folder}: two images are called '{names[counts > 1][0]}': give each its own name"
        )
    camera = _known(
        folder, "an image names camera {}, which is not there", images.camera, camera_ids
    )
    rig = _known(folder, "a frame names rig {}, which is not there", frames.rig, rig_ids)
    _known(folder, "a rig names camera {}, which is not there", mounted, camera_ids)
    _known(folder, "no rig has camera {}", images.camera, mounted)
    frame = owner[_known(folder, "no frame has image {}", images.id, image)]
    order, observing = np.argsort(points.id), images.point != colmap.NO_POINT
    points = colmap.ColmapPoints(*(column[order] for column in vars(points).values()))
    point, named = images.point.copy(), images.point[observing]
    point[observing] = _known(
        folder, "a keypoint names point {}, which is not there", named, points.id
    )
    return colmap.ColmapModel(
        cameras,
        tuple(
            dataclasses.replace(
                rig, cameras=tuple(colmap.rows_of(camera_ids, np.array(rig.cameras)).tolist())
            )
            for rig in rigs
        ),
        dataclasses.replace(frames, rig=rig),
        dataclasses.replace(images, camera=camera, frame=frame, point=point),
        points,
    )


def _cameras(file: Records) -> tuple[colmap.ColmapCamera, ...]:
    cameras = []
    for _ in file.records(24):
        (number,), kind = file.integers("I"), file.word(_CAMERA_MODELS)
        if kind not in colmap.MODELS:
            raise file.damaged(f"camera {number} has the unknown camera model {kind}")
        model, (width, height) = colmap.MODELS[kind], file.integers("QQ")
        file.wanted = f"{model.name} with {model.parameters} parameters"
        parameters = file.doubles(model.parameters)
        if not np.isfinite(parameters).all():
            raise file.damaged("it has numbers that are not finite")
        if not (0 < width < 1 << 31 and 0 < height < 1 << 31):
            raise file.damaged(f"the images of camera {number} have no pixels")
        cameras.append(colmap.ColmapCamera(number, kind, width, height, parameters))
    return tuple(cameras)


def _rigs(file: Records) -> tuple[colmap.ColmapRig, ...]:
    """Return the rigs with the ids of their cameras; poses are on whatever sensor is the reference."""
    rigs = []
    for _ in file.records(8):
        number, count = file.integers("II")
        cameras: list[int] = []
        poses: list[F64] = []
        for place in range(count):
            kind, (sensor,) = file.word(_SENSORS), file.integers("I")
            is_known = not place or file.integers("B")[0]
            pose = file.pose() if place and is_known else se3.identity()
            if kind == colmap.CAMERA_SENSOR:
                cameras.append(sensor)
                poses.append(pose if is_known else np.full(7, np.nan))
        rigs.append(colmap.ColmapRig(number, tuple(cameras), _rows(poses)))
    return tuple(rigs)


def _frames(file: Records) -> tuple[colmap.ColmapFrames, I64, I64]:
    """Return the frames with the ids of their rigs, and rows of frames and ids of the images in them."""
    poses: list[F64] = []
    heads: list[tuple[int, int]] = []
    images: list[tuple[int, int]] = []
    for row, _ in enumerate(file.records(68)):
        number, rig = file.integers("II")
        heads.append((number, rig))
        poses.append(file.pose())
        for _ in range(*file.integers("I")):
            kind, (_, image) = file.word(_SENSORS), file.integers("IQ")
            if kind == colmap.CAMERA_SENSOR:
                images.append((row, image))
    return colmap.ColmapFrames(*_columns(heads), _rows(poses)), *_columns(images)


def _images(file: Records) -> colmap.ColmapImages:
    heads, poses, names = [], [], []
    keypoints = [np.zeros(0, dtype=colmap.KEYPOINT)]
    for _ in file.records(69):
        (number,), pose, (camera,) = file.integers("I"), file.pose(), file.integers("I")
        names.append(file.text())
        keypoints.append(file.keypoints())
        heads.append((number, camera))
        poses.append(pose)
    table = np.concatenate(keypoints)
    if not np.all(np.isfinite(table["uv"])):
        raise file.damaged("it has keypoints that are not finite")
    ids, cameras = _columns(heads)
    return colmap.ColmapImages(
        ids,
        cameras,
        np.zeros_like(ids),
        _rows(poses),
        tuple(names),
        np.array([len(part) for part in keypoints[1:]], dtype=np.int64),
        np.ascontiguousarray(table["uv"], dtype=np.float64),
        np.ascontiguousarray(table["point"], dtype=np.int64),
    )


def _points(file: Records) -> colmap.ColmapPoints:
    table = file.points()
    p_W = np.ascontiguousarray(table["p_W"], dtype=np.float64)
    if not np.all(np.isfinite(p_W)):
        raise file.damaged("it has points that are not finite")
    ids, error_px = table["id"].astype(np.int64), table["error"].astype(np.float64)
    return colmap.ColmapPoints(ids, p_W, table["colour"].copy(), error_px)


def _columns(rows: list[tuple[int, int]]) -> tuple[I64, I64]:
    first, second = np.array(rows, dtype=np.int64).reshape(-1, 2).T.copy()
    return first, second


def _rows(poses: list[F64]) -> F64:
    return np.array(poses, dtype=np.float64).reshape(-1, 7)


def _known(source: Path, sentence: str, named: I64, known: I64) -> I64:
    """Return the rows of named ids in a column of ids."""
    rows = colmap.rows_of(known, named)
    _refuse(source, sentence, named, rows < 0)
    return rows


def _refuse(source: Path, sentence: str, ids: I64, wrong: Mask) -> None:
    if np.any(wrong):
        raise MapError(f"{source}: is damaged: {sentence.format(int(ids[wrong][0]))}; {REMEDY}")


_FILES = ("cameras.bin", "cameras.txt")


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
        cameras = _cameras(FILES_OF[path.suffix](path))
        T_R_C = np.atleast_2d(se3.identity())
        if len(cameras) != 1:
            raise UserError(
                f"{path}: has {len(cameras)} cameras, and does not say how they are mounted: name the "
                "folder of a model with a rig of them"
            )
    return [colmap.map_camera(camera, "") for camera in cameras], se3.relative(T_R_C[0], T_R_C)


def _rig(model: colmap.ColmapModel, folder: Path) -> tuple[tuple[colmap.ColmapCamera, ...], F64]:
    """Return the cameras of a model's rig and their poses T_R_C (n, 7)."""
    if len(model.rigs) != 1:
        raise UserError(
            f"{folder}: has {len(model.rigs)} rigs: a calibration is of one; give a model of one rig, or a "
            "cameras.txt of one camera"
        )
    rig = model.rigs[0]
    if not np.isfinite(rig.T_C_R).all():
        raise UserError(f"{folder}: rig {rig.id} has a camera without pose: reconstruct it first")
    return tuple(model.cameras[row] for row in rig.cameras), se3.inverse(rig.T_C_R)
