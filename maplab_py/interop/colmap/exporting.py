"""Export maps as COLMAP models, with a database of keypoints, descriptors and matches."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64
from maplab_py.errors import FlagError, UserError
from maplab_py.interop.colmap.binary import binary_files
from maplab_py.interop.colmap.child import TEXT
from maplab_py.interop.colmap.child_process import run_job, write_job_model
from maplab_py.interop.colmap.from_map import ExportedModel, model_of_map
from maplab_py.interop.colmap.model import FILES, NO_POINT
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapExportReport
from maplab_py.interop.colmap.side_file import FILE_NAME
from maplab_py.interop.colmap.undistortion import undistorted
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import (
    DescriptorDepth,
    FeatureType,
    type_name,
    type_of_name,
    types_of,
)
from maplab_py.vimap.keypoint_removal import remove_keypoints
from maplab_py.vimap.table import starts_of_counts

DATABASE = "database.db"
_CHUNK_BYTES = 1 << 24


def export_colmap(
    vi_map: VIMap,
    folder: Path,
    options: ColmapExportOptions | None = None,
    *,
    missions: I64 | None = None,
    overwrite: bool = False,
) -> ColmapExportReport:
    """Write a COLMAP model of some missions (rows, None = all), with a side file of the map's ids.

    Raises:
        UserError: A file exists and `overwrite` is not set, the folder has a model in the other format,
            nothing can be written, or COLMAP lacks a camera model.
        MapError: pycolmap fails.
    """
    options = options or ColmapExportOptions()
    names = _check_folder(folder, options, overwrite=overwrite)
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    lost = 0
    if options.colmap_feature_type:
        vi_map = _of_type(vi_map, options.colmap_feature_type)
    if options.undistort:
        vi_map, lost = undistorted(vi_map, rows)
    exported = model_of_map(vi_map, rows, quality=options.quality)
    model = exported.model
    with tempfile.TemporaryDirectory(prefix="maplab-colmap-") as name:
        work = Path(name)
        if options.colmap_format == "text" or options.colmap_database:
            write_job_model(model, work)
        if options.colmap_format == "text":
            run_job("write_text", work, folder)
            for kind in FILES:
                path = folder / f"{kind}.txt"
                write_bytes(path, _chunks(work / TEXT / path.name), overwrite=overwrite)
        else:
            for file, content in binary_files(model).items():
                write_bytes(folder / file, content, overwrite=overwrite)
        write_bytes(folder / FILE_NAME, [exported.side_file.content()], overwrite=overwrite)
        if options.colmap_database:
            _write_database(vi_map, exported, options, work, folder, overwrite=overwrite)
    return ColmapExportReport(
        folder=folder,
        cameras=len(model.cameras),
        rigs=len(model.rigs),
        frames=len(model.frames.id),
        images=len(model.images.id),
        points=len(model.points.id),
        observations=exported.observations,
        mean_reprojection_error_px=exported.mean_error_px,
        observations_lost_by_undistortion=lost,
        files=tuple(folder / file for file in names),
    )


def _of_type(vi_map: VIMap, name: str) -> VIMap:
    """Return the map with the keypoints of a feature type alone.

    Raises:
        UserError: It has none, or there is no such type.
    """
    try:
        feature_type = type_of_name(name)
    except FlagError as error:
        raise FlagError(f"--colmap_feature_type: {error}") from None
    other = vi_map.feature_type != feature_type
    if other.all():
        types = ", ".join(type_name(kind) for kind in sorted(types_of(vi_map.frames))) or "none"
        raise UserError(
            f"--colmap_feature_type={name}: the map has no such keypoints; its types: {types}"
        )
    return remove_keypoints(vi_map, other)


def _check_folder(
    folder: Path, options: ColmapExportOptions, *, overwrite: bool
) -> tuple[str, ...]:
    """Return the names of the files to write."""
    if options.colmap_pose_priors and not options.colmap_database:
        raise UserError("--colmap_pose_priors needs the database: give --colmap_database too")
    is_text = options.colmap_format == "text"
    suffix, other = (".txt", ".bin") if is_text else (".bin", ".txt")
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--colmap_folder={folder} is a file: name a folder")
    for kind in FILES:
        if (folder / f"{kind}{other}").exists():
            raise UserError(
                f"--colmap_folder={folder}: holds {kind}{other}, a model in the other format, which COLMAP "
                "could read instead: choose another folder"
            )
    names = [f"{kind}{suffix}" for kind in FILES] + [FILE_NAME]
    names += [DATABASE] if options.colmap_database else []
    for file in names:
        check_writable(folder / file, overwrite=overwrite)
    return tuple(names)


def _write_database(
    vi_map: VIMap,
    exported: ExportedModel,
    options: ColmapExportOptions,
    work: Path,
    folder: Path,
    *,
    overwrite: bool,
) -> None:
    arrays: dict[str, Any] = database_arrays(vi_map, exported)
    if options.colmap_pose_priors:
        arrays["priors"] = np.ones(1)
    np.savez(work / "database.npz", **arrays)
    run_job("database", work, folder / DATABASE)
    write_bytes(folder / DATABASE, _chunks(work / DATABASE), overwrite=overwrite)


def _chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        while chunk := stream.read(_CHUNK_BYTES):
            yield chunk


_MAX_GAP = 50
"""Pairs of images are matched up to this many observations of a landmark apart."""
_MIN_MATCHES = 15
"""COLMAP's least number of inliers of a pair."""


def database_arrays(vi_map: VIMap, exported: ExportedModel) -> dict[str, NDArray[Any]]:
    """Return the columns of the database by name.

    Keypoints are float32 as COLMAP stores them: x, y, scale, orientation (0).
    """
    images = exported.model.images
    keypoints = np.zeros((len(images.uv), 4), dtype=np.float32)
    keypoints[:, :2] = images.uv
    scale = vi_map.keypoints.scale[exported.keypoints]
    keypoints[:, 2] = np.where(scale > 0.0, scale, 1.0)
    size, is_sift = _descriptor_sizes(vi_map, exported.frames)
    pairs, start, matches = matches_of_landmarks(exported)
    return {
        "images": images.id,
        "keypoint_start": images.keypoint_start,
        "keypoints": keypoints,
        "descriptors": vi_map.keypoints.descriptor[exported.keypoints],
        "descriptor_bytes": size,
        "is_sift": is_sift,
        "pairs": pairs,
        "match_start": start,
        "matches": matches,
    }


def _descriptor_sizes(vi_map: VIMap, frames: I64) -> tuple[I64, NDArray[np.bool_]]:
    """Return the bytes (N,) of each frame's descriptors, and whether they are SIFT.

    COLMAP has one kind of descriptor in an image; frames with several get 0.
    """
    blocks = vi_map.frames.descriptor_blocks[frames]
    kinds = [{block[1:] for block in of_frame or () if block.keypoints} for of_frame in blocks]
    single = [next(iter(kind)) if len(kind) == 1 else (0, 0, 0) for kind in kinds]
    size = np.array([entry[0] for entry in single], dtype=np.int64)
    sift = (DescriptorDepth.UINT8, FeatureType.SIFT)
    return size, np.array([entry[1:] == sift for entry in single], dtype=np.bool_)


def matches_of_landmarks(exported: ExportedModel) -> tuple[I64, I64, NDArray[np.uint32]]:
    """Return pairs of image ids (P, 2), offsets (P + 1,), and matched keypoints (sum, 2).

    Two images match in the keypoints that observe the same landmark; pairs with few matches are left
    out.
    """
    images = exported.model.images
    observing = np.flatnonzero(images.point != NO_POINT)
    observing = observing[np.argsort(images.point[observing], kind="stable")]
    point, image = images.point[observing], images.keypoint_image[observing]
    keypoint = observing - images.keypoint_start[image]
    parts = []
    for gap in range(1, _MAX_GAP + 1):
        a = np.flatnonzero(point[gap:] == point[:-gap])
        if not len(a):
            break
        a = a[image[a] != image[a + gap]]
        ends = np.stack([image[a], image[a + gap], keypoint[a], keypoint[a + gap]], axis=1)
        parts.append(ends)
    table = np.concatenate(parts) if parts else np.zeros((0, 4), dtype=np.int64)
    table = table[np.lexsort((table[:, 3], table[:, 2], table[:, 1], table[:, 0]))]
    pairs, count = np.unique(table[:, :2], axis=0, return_counts=True)
    kept = count >= _MIN_MATCHES
    table = table[np.repeat(kept, count)]
    return images.id[pairs[kept]], starts_of_counts(count[kept]), table[:, 2:].astype(np.uint32)
