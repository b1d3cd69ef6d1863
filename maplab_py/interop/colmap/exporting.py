"""Export maps as COLMAP models: files in a folder, and a database on request."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import FlagError, UserError
from maplab_py.interop.colmap.binary_writing import binary_files
from maplab_py.interop.colmap.child import TEXT
from maplab_py.interop.colmap.child_process import run_job, write_job_model
from maplab_py.interop.colmap.database_writing import database_arrays
from maplab_py.interop.colmap.from_map import ExportedModel, model_of_map
from maplab_py.interop.colmap.model import FILES
from maplab_py.interop.colmap.options import ColmapExportOptions, ColmapExportReport
from maplab_py.interop.colmap.side_file import FILE_NAME
from maplab_py.interop.colmap.undistortion import undistorted
from maplab_py.output_files import check_writable, write_bytes
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import type_name, type_of_name, types_of
from maplab_py.vimap.keypoint_removal import remove_keypoints

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
