"""Read the model of a folder, in either format, and check the references within it."""

import dataclasses
import re
import struct
import tempfile
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.atomic import replaced_file
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.input_files import read_bytes
from maplab_py.interop.colmap import model as colmap
from maplab_py.interop.colmap.binary import REMEDY, read_binary, read_binary_cameras
from maplab_py.interop.colmap.child import BINARY, TEXT
from maplab_py.interop.colmap.child_process import run_job
from maplab_py.sensors import Camera

_ROUNDING = 1e-9
_ANNOUNCED = re.compile(r"# Number of \w+: (\d+)")
_HEADER_BYTES = 4096
_NEEDED = ("cameras", "images", "points3D")


def read_model(folder: Path) -> colmap.ColmapModel:
    """Read and check a model; binary files come before text files, as in COLMAP.

    Raises:
        UserError: The folder has no model.
        MapError: A file is missing, damaged, or does not fit the others.
    """
    if not folder.is_dir():
        raise UserError(f"--colmap_folder={folder}: no such folder")
    if (folder / "images.bin").exists() or (folder / "cameras.bin").exists():
        model = read_binary(folder)
    elif (folder / "images.txt").exists():
        model = _read_text(folder)
    else:
        raise UserError(
            f"--colmap_folder={folder}: has no COLMAP model (cameras, images, points3D as .bin or .txt)"
            f"{_models_below(folder)}"
        )
    check_model(model, folder)
    return model


def _models_below(folder: Path) -> str:
    """Return a clause on the models in folders below, with what they have; empty without any."""
    below = [path for path in (*folder.glob("*"), *folder.glob("sparse/*")) if path.is_dir()]
    models: list[tuple[int, str]] = []
    for path in sorted(below):
        suffixes = [
            s for s in (".bin", ".txt") if any((path / f"{kind}{s}").is_file() for kind in _NEEDED)
        ]
        if not suffixes:
            continue
        name, suffix = path.relative_to(folder).as_posix(), suffixes[0]
        missing = [
            f"{kind}{suffix}" for kind in _NEEDED if not (path / f"{kind}{suffix}").is_file()
        ]
        counts = [_count(path / f"{kind}{suffix}") for kind in ("images", "points3D")]
        said = (
            f"incomplete: no {', '.join(missing)}"
            if missing
            else f"{counts[0]} images, {counts[1]} points"
        )
        images = 0 if missing or counts[0] == "?" else int(counts[0])
        models.append((images, f"{name} ({said})"))
    if not models:
        return ""
    models.sort(key=lambda model: -model[0])
    largest = f"; the largest is {folder / models[0][1].split(' (')[0]}" if models[0][0] else ""
    return f"; it has models in {', '.join(text for _, text in models)}{largest}"


def _count(path: Path) -> str:
    """Return the number of records that a file announces, ? where it does not."""
    try:
        if path.suffix == ".txt":
            announced = _announced(path)
            return "?" if announced is None else str(announced)
        with path.open("rb") as stream:
            return str(*struct.unpack("<Q", stream.read(8)))
    except (OSError, struct.error):
        return "?"


def _read_text(folder: Path) -> colmap.ColmapModel:
    """Let pycolmap convert the text, and compare the result with what the files announce.

    Names and poses of images are read here: pycolmap cuts names at blanks, and takes poses from the frames.
    """
    for kind in _NEEDED:
        path = folder / f"{kind}.txt"
        if not path.is_file():
            raise MapError(f"cannot read {path}: it is not there; {REMEDY}")
    with tempfile.TemporaryDirectory(prefix="maplab-colmap-") as name:
        work = Path(name)
        (work / TEXT).mkdir()
        for kind in colmap.FILES:
            path = folder / f"{kind}.txt"
            if kind != "images" and path.is_file():
                (work / TEXT / path.name).symlink_to(path.resolve())
        names, poses = _text_images(folder / "images.txt", work / TEXT / "images.txt")
        run_job("write_binary", work, folder)
        try:
            model = read_binary(work / BINARY)
        except MapError as error:  # of the file that was converted
            reason = (
                str(error).replace(str(work / BINARY), str(folder)).replace(".bin: ", ".txt: ", 1)
            )
            raise MapError(reason) from None
    images = model.images
    ids = images.id.tolist()
    T_C_W = np.array([poses[number] for number in ids]).reshape(-1, 7)
    images = dataclasses.replace(images, name=tuple(names[number] for number in ids), T_C_W=T_C_W)
    counts = {
        "cameras": len(model.cameras),
        "rigs": len(model.rigs),
        "frames": len(model.frames.id),
        "images": len(images.id),
        "points3D": len(model.points.id),
    }
    for kind, count in counts.items():
        path = folder / f"{kind}.txt"
        wanted = _announced(path)
        if wanted is not None and wanted != count:
            raise MapError(
                f"{path}: is damaged: it announces {wanted} records and has {count}; {REMEDY}"
            )
    return dataclasses.replace(model, images=images)


def _text_images(path: Path, copy: Path) -> tuple[dict[int, str], dict[int, F64]]:
    """Return names and poses T_C_W (7,) by the ids of images, and write a copy with names without blanks.

    Raises:
        MapError: A line is no image; names it.
    """
    names: dict[int, str] = {}
    poses: dict[int, F64] = {}
    try:
        with (
            path.open(encoding="utf-8-sig") as stream,
            replaced_file(copy, durable=False) as target,
        ):
            for number, line in enumerate(stream, start=1):
                words = line.split(maxsplit=9)
                if not words or words[0].startswith("#"):
                    continue
                try:
                    image, values = int(words[0]), np.array(words[1:8], dtype=np.float64)
                    name = words[9].strip()
                except (ValueError, IndexError):
                    raise MapError(
                        f"{path}:{number}: is no image: wants IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                    ) from None
                length = np.linalg.norm(values[:4])
                if not np.isfinite(values).all() or length == 0.0:
                    raise MapError(f"{path}:{number}: the pose of image {image} is none; {REMEDY}")
                names[image] = name
                poses[image] = np.concatenate([values[[1, 2, 3, 0]] / length, values[4:]])
                if abs(length - 1.0) > _ROUNDING:  # COLMAP takes quaternions of any length
                    words[1:5] = map(repr, (values[:4] / length).tolist())
                record = " ".join(words[:9]) + f" {image}\n" + next(stream, "\n")
                target.write(record.encode())
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}; {REMEDY}") from error
    except UnicodeDecodeError as error:
        raise MapError(f"{path}: is damaged: it is not UTF-8 text; {REMEDY}") from error
    return names, poses


def _announced(path: Path) -> int | None:
    """Return the number of records that the head of a text file tells, None if it does not."""
    if not path.is_file():
        return None
    with path.open("rb") as stream:
        match = _ANNOUNCED.search(stream.read(_HEADER_BYTES).decode("utf-8", errors="replace"))
    return int(match[1]) if match else None


def check_model(model: colmap.ColmapModel, source: Path) -> None:
    """Check that ids are unique, that what is named exists, and that there are images.

    Raises:
        MapError: A check fails; names the source and the id.
    """
    images, frames, points = model.images, model.frames, model.points
    if not len(images.id):
        raise MapError(f"{source}: the model has no images with a pose: nothing can be imported")
    cameras, rigs = model.camera_ids, model.rig_ids
    sensors = np.array([c for rig in model.rigs for c in rig.cameras], dtype=np.int64)
    for noun, ids in (
        ("camera", cameras),
        ("rig", rigs),
        ("camera in a rig", sensors),
        ("frame", frames.id),
        ("image", images.id),
        ("image in a frame", frames.image_id),
        ("point", points.id),
    ):
        values, counts = np.unique(ids, return_counts=True)
        _refuse(source, f"{noun} {{}} is there twice", values, counts > 1)
    names, counts = np.unique(np.array(images.name), return_counts=True)
    if np.any(counts > 1):
        raise MapError(
            f"{source}: two images are called '{names[counts > 1][0]}': give each its own name"
        )
    _known(source, "an image names camera {}", images.camera, cameras)
    _known(source, "a frame names rig {}", frames.rig, rigs)
    _known(source, "no frame has image {}", images.id, frames.image_id)
    _known(source, "no rig has camera {}", images.camera, sensors)
    observed = images.point[images.point != colmap.NO_POINT]
    _known(source, "a keypoint names point {}", observed, points.id)


def _known(source: Path, sentence: str, named: I64, known: I64) -> None:
    _refuse(source, f"{sentence}, which is not there", named, ~np.isin(named, known))


def _refuse(source: Path, sentence: str, ids: I64, wrong: Mask) -> None:
    if np.any(wrong):
        text = sentence.format(int(ids[wrong][0]))
        if text.startswith("no "):
            text = text.removesuffix(", which is not there")
        raise MapError(f"{source}: is damaged: {text}; {REMEDY}")


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
    return [colmap.map_camera(camera, "") for camera in cameras], se3.relative(T_R_C[0], T_R_C)


def _rig(model: colmap.ColmapModel, folder: Path) -> tuple[tuple[colmap.ColmapCamera, ...], F64]:
    """Return the cameras of a model's rig and their poses T_R_C (n, 7)."""
    if len(model.rigs) != 1:
        raise UserError(
            f"{folder}: has {len(model.rigs)} rigs: a calibration is of one; give a model of one rig, or a "
            "cameras.txt of one camera"
        )
    rig = model.rigs[0]
    by_id = {camera.id: camera for camera in model.cameras}
    if not np.isfinite(rig.T_C_R).all():
        raise UserError(f"{folder}: rig {rig.id} has a camera without pose: reconstruct it first")
    return tuple(by_id[number] for number in rig.cameras), se3.inverse(rig.T_C_R)


def _text_cameras(path: Path) -> tuple[colmap.ColmapCamera, ...]:
    """Read cameras.txt: lines of id, model, width, height and parameters.

    Raises:
        MapError: It cannot be read, or a line is wrong.
    """
    try:
        data = read_bytes(path, _MAX_BYTES, remedy="it is no file of cameras", error=MapError)
    except OSError as error:
        raise MapError(f"cannot read {path}: {error.strerror}; {REMEDY}") from error
    numbers = {model.name: model.number for model in colmap.MODELS.values()}
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
        model = colmap.MODELS[numbers[words[1]]]
        if len(parameters) != model.parameters or not np.isfinite(parameters).all():
            raise MapError(
                f"{path}:{number}: {model.name} has {model.parameters} parameters that are numbers, not "
                f"{len(parameters)}; {REMEDY}"
            )
        if not (0 < width < 1 << 31 and 0 < height < 1 << 31):
            raise MapError(f"{path}:{number}: the images have no pixels; {REMEDY}")
        cameras.append(colmap.ColmapCamera(camera_id, model.number, width, height, parameters))
    return tuple(cameras)
