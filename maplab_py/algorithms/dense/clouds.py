"""Depth maps as point clouds, and clouds of a camera as depth maps."""

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.dense import resources as frame_resources
from maplab_py.array_types import F32, F64, U8
from maplab_py.errors import MapError, UserError
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors import Camera, projection
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import ResourceOwner, VIMap, resources_of


class ConvertedDepthMaps(Report):
    """Depth maps that became point clouds; they are written when the map is saved."""

    depth_maps: int
    clouds_with_colours: int
    clouds_without: int
    points: int
    frames_with_cloud: int


class CloudMaker:
    """Makes clouds of the depth maps of one camera."""

    def __init__(self, camera: Camera) -> None:
        u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
        rays, valid = projection.back_project(camera, np.stack([u, v], axis=-1))
        self._valid = valid & (rays[..., 2] > 0.0)
        z = np.where(self._valid, rays[..., 2], 1.0)
        self._points = rays / z[..., None]

    def cloud(self, depth: F32, image: U8 | None = None) -> PlyCloud:
        """Return the points in the camera's frame of a depth map (H, W) [m].

        Args:
            depth: Depths along the optical axis at the pixels of the distorted image, 0 = unknown.
            image: Grey (H, W) or BGR (H, W, 3) image of the same pixels, for colours.
        """
        known = self._valid & (depth > 0.0)
        p_C = self._points[known] * depth[known, None]
        return PlyCloud(p_C, None if image is None else _colours(image[known]))


def _colours(pixels: Any) -> U8:
    if pixels.ndim == 1:
        return np.repeat(pixels[:, None], 3, axis=1).astype(np.uint8)
    return np.ascontiguousarray(pixels[:, ::-1], dtype=np.uint8)


def depth_of_cloud(camera: Camera, p_C: F64) -> F32:
    """Return the depth map (H, W) [m] of points (N, 3) in a camera's frame: the nearest in each pixel."""
    uv, visible = projection.project(camera, p_C)
    pixels = np.round(uv[visible]).astype(np.int64)
    z = p_C[visible, 2]
    inside = projection.is_inside_image(camera, pixels) & (z > 0.0)
    depth = np.full((camera.height_px, camera.width_px), np.inf, dtype=np.float32)
    np.minimum.at(depth, (pixels[inside, 1], pixels[inside, 0]), z[inside].astype(np.float32))
    return np.where(np.isfinite(depth), depth, np.float32(0.0))


def convert_depth_maps(
    vi_map: VIMap, map_folder: Path, *, progress: Progress = SILENT
) -> tuple[VIMap, ConvertedDepthMaps]:
    """Make a cloud of every depth map, with colours where its frame has an image.

    Frames that have a cloud keep it.

    Raises:
        UserError: The map has no depth maps.
        MapError: A file is missing or damaged.
    """
    resources = frame_resources.FrameResources(vi_map, map_folder)
    rows = np.flatnonzero(resources_of(vi_map, frame_resources.DEPTH_MAPS))
    if not len(rows):
        raise UserError(
            "the map has no depth maps: stereo_dense_reconstruction makes some",
            remedy="stereo_dense_reconstruction",
        )
    if (vi_map.resources.owner_kind[rows] != ResourceOwner.FRAME).any():
        raise MapError("a depth map belongs to no frame: see check_map_consistency")
    had = np.isin(
        vi_map.resources.owner[rows],
        vi_map.resources.owner[
            resources_of(vi_map, frame_resources.CLOUDS)
            & (vi_map.resources.owner_kind == ResourceOwner.FRAME)
        ],
    )
    images = frame_resources.FrameImages(vi_map, map_folder)
    makers: dict[str, CloudMaker] = {}
    new = NewResources(seed=b"clouds")
    owners, points, coloured = [], 0, 0
    for done, row in enumerate(rows[~had].tolist()):
        progress.step(done, len(rows), "point clouds")
        frame = int(vi_map.resources.owner[row])
        camera = resources.camera(frame)
        maker = makers.setdefault(camera.id, CloudMaker(camera))
        image = images.image(frame)
        cloud = maker.cloud(resources.depth(row), image)
        kind = frame_resources.COLOUR_CLOUDS if image is not None else frame_resources.CLOUDS[0]
        new.add(kind, b"".join(encode_ply(cloud)))
        owners.append(frame)
        points += len(cloud.p)
        coloured += image is not None
    converted = new.attached(vi_map, np.arange(len(new)), owners) if len(new) else vi_map
    report = ConvertedDepthMaps(
        len(rows), coloured, len(new) - coloured, points, int(np.count_nonzero(had))
    )
    return converted, report
