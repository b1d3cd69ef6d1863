"""Write a map's images, poses and landmarks as a dense workspace of COLMAP or a folder of PMVS."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.dense.export.views import PointTracks, UndistortedViews
from maplab_py.array_types import F64, U8
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.mvs.colmap_model import encode_model
from maplab_py.interop.mvs.pmvs import (
    bundler_text,
    file_number,
    list_text,
    option_text,
    projection_text,
)
from maplab_py.interop.mvs.scene import MvsScene
from maplab_py.output_files import check_writable, write_bytes, write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap.ids import to_hex

_GREY = 128
_SOURCES = 20
"""Source images per reference image in COLMAP's patch match."""
_IMAGE_SUFFIXES = (".ppm", ".jpg")


@dataclasses.dataclass(frozen=True)
class MvsExport(Report):
    """Files written for multi-view stereo."""

    folder: Path
    images: int
    cameras: int
    points: int
    observations: int
    median_error_px: float  # of the points in the undistorted images


def write_colmap_workspace(
    views: UndistortedViews,
    folder: Path,
    *,
    only_good: bool = True,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MvsExport:
    """Write a dense workspace: images, sparse model and the settings of patch match and fusion.

    `colmap patch_match_stereo --workspace_path=...` and `stereo_fusion` work on it.

    Raises:
        UserError: A file exists and `overwrite` is not set, or cannot be written.
        MapError: An image is missing or damaged.
        Cancelled: The user wants to stop.
    """
    names = [_colmap_name(views, view) for view in range(len(views))]
    check_writable(folder / "sparse" / "cameras.bin", overwrite=overwrite)
    tracks, scene = _scene(views, names, only_good=only_good)
    colours = np.full((len(scene.p_G), 3), _GREY, dtype=np.uint8)
    for view, image in _images(views, progress):
        write_bytes(folder / "images" / names[view], [_encode(image, ".png")], overwrite=overwrite)
        _paint(colours, image, tracks, view)
    model = encode_model(dataclasses.replace(scene, colours=colours))
    for name, content in model.items():
        write_bytes(folder / "sparse" / name, [content], overwrite=overwrite)
    settings = (f"{name}\n__auto__, {_SOURCES}\n" for name in names)
    write_text(folder / "stereo" / "patch-match.cfg", settings, overwrite=overwrite)
    fused = (f"{name}\n" for name in names)
    write_text(folder / "stereo" / "fusion.cfg", fused, overwrite=overwrite)
    for name in ("depth_maps", "normal_maps", "consistency_graphs"):
        _keep(folder / "stereo" / name, overwrite=overwrite)
    return _report(folder, views, scene)


def write_pmvs_folder(
    views: UndistortedViews,
    folder: Path,
    *,
    image_format: str = "ppm",
    only_good: bool = True,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> MvsExport:
    """Write images, projection matrices and a Bundler file for CMVS and PMVS-2.

    Raises:
        UserError: The format is not known, a file exists, or cannot be written.
        MapError: An image is missing or damaged.
        Cancelled: The user wants to stop.
    """
    suffix = f".{image_format}"
    if suffix not in _IMAGE_SUFFIXES:
        known = ", ".join(name[1:] for name in _IMAGE_SUFFIXES)
        raise UserError(f"--pmvs_image_format={image_format}: choose one of {known}")
    check_writable(folder / "bundle.rd.out", overwrite=overwrite)
    names = [file_number(view) + suffix for view in range(len(views))]
    tracks, scene = _scene(views, names, only_good=only_good)
    colours = np.full((len(scene.p_G), 3), _GREY, dtype=np.uint8)
    for view, image in _images(views, progress):
        content = _encode(_three_channels(image), suffix)
        write_bytes(folder / "visualize" / names[view], [content], overwrite=overwrite)
        matrix = folder / "txt" / f"{file_number(view)}.txt"
        write_text(matrix, [projection_text(scene, view)], overwrite=overwrite)
        _paint(colours, image, tracks, view)
    scene = dataclasses.replace(scene, colours=colours)
    for name, text in (
        ("list.rd.txt", list_text(names)),
        ("option-all", option_text(len(names))),
        ("bundle.rd.out", bundler_text(scene)),
    ):
        write_text(folder / name, [text], overwrite=overwrite)
    _keep(folder / "models", overwrite=overwrite)
    return _report(folder, views, scene)


def _scene(
    views: UndistortedViews, names: list[str], *, only_good: bool
) -> tuple[PointTracks, MvsScene]:
    tracks = views.tracks(only_good=only_good)
    size = [[p.width_px, p.height_px] for p in views.pinholes]
    K = [[p.focal_px, p.focal_px, *p.centre_px] for p in views.pinholes]
    scene = MvsScene(
        np.array(size, dtype=np.int64),
        np.array(K),
        views.camera_of_view,
        names,
        views.T_C_G,
        tracks.p_G,
        np.full((len(tracks.p_G), 3), _GREY, dtype=np.uint8),
        tracks.landmark,
        tracks.view,
        tracks.uv_px,
        np.zeros(len(tracks.p_G)),
    )
    return tracks, dataclasses.replace(scene, error_px=_errors_px(scene))


def _errors_px(scene: MvsScene) -> F64:
    """Return the mean reprojection error (L,) [px] of the points."""
    p_C = se3.transform(scene.T_C_G[scene.view], scene.p_G[scene.landmark])
    K = scene.K[scene.camera[scene.view]]
    z = np.maximum(p_C[:, 2:], 1e-6)
    error = np.linalg.norm(K[:, :2] * p_C[:, :2] / z + K[:, 2:] - scene.uv_px, axis=1)
    count = np.maximum(np.bincount(scene.landmark, minlength=len(scene.p_G)), 1)
    return np.asarray(np.bincount(scene.landmark, error, minlength=len(scene.p_G)) / count)


def _images(views: UndistortedViews, progress: Progress) -> Iterator[tuple[int, Any]]:
    for view in range(len(views)):
        progress.step(view, len(views), "undistorting images")
        yield view, views.image(view)


def _paint(colours: U8, image: Any, tracks: PointTracks, view: int) -> None:
    """Give the points that an image shows the colours of their pixels."""
    rows = np.flatnonzero(tracks.view == view)
    u, v = np.round(tracks.uv_px[rows]).astype(np.int64).T
    colours[tracks.landmark[rows]] = _three_channels(image)[v, u, ::-1]


def _three_channels(image: Any) -> Any:
    return np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image


def _encode(image: Any, suffix: str) -> bytes:
    import cv2

    return bytes(cv2.imencode(suffix, image)[1])


def _colmap_name(views: UndistortedViews, view: int) -> str:
    """Return the file of an image: mission, camera and time stamp."""
    vi_map, frame = views.vi_map, int(views.frames[view])
    mission = int(vi_map.vertices.mission[vi_map.frames.vertex[frame]])
    name = to_hex(vi_map.missions.id[mission])[:8]
    camera = int(vi_map.frames.camera_index[frame])
    return f"{name}_cam{camera}_{int(vi_map.frames.timestamp_ns[frame])}.png"


def _keep(folder: Path, *, overwrite: bool) -> None:
    """Make a folder that the other program writes into: it gets an empty file."""
    write_bytes(folder / ".keep", [b""], overwrite=overwrite)


def _report(folder: Path, views: UndistortedViews, scene: MvsScene) -> MvsExport:
    error = float(np.median(scene.error_px)) if len(scene.p_G) else 0.0
    return MvsExport(
        folder,
        len(scene.names),
        len(views.cameras),
        len(scene.p_G),
        len(scene.landmark),
        error,
    )
