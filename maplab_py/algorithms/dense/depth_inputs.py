"""Inputs of fusion: the depth of missions in a common frame, in one grid each."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.clouds import depth_of_cloud
from maplab_py.algorithms.dense.grid import GridSettings, TsdfGrid, View, blocks_of_views
from maplab_py.algorithms.dense.options import FusionOptions
from maplab_py.algorithms.dense.pinhole import ImageMap, Pinhole, undistorted
from maplab_py.algorithms.dense.resources import CLOUDS, DEPTH_MAPS, FrameResources
from maplab_py.array_types import F32, F64, I64
from maplab_py.errors import EstimationError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.ply import parse_ply
from maplab_py.progress import Progress
from maplab_py.report import counted
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap, resources_of, to_hex

_INPUT_TYPES = (9, 8, 17, 16, 21)
"""Resource types of depth, the preferred first: optimised, raw, clouds."""


_VOXELS_IN_DEPTH = 40
_VOXELS_M = (0.01, 0.015, 0.02, 0.03, 0.04, 0.05, 0.075, 0.10)
"""Sides of voxels that are chosen: of steps, so that the noise of the depth does not change them."""
_LOOKED_AT = 20
"""Depth maps that tell the depth of a scene."""


@dataclasses.dataclass(frozen=True)
class SceneDepth:
    """Depth of a scene, of some of its depth maps."""

    median_m: float
    share_in_range: float  # of the pixels with depth

    @classmethod
    def of(cls, depth: DepthViews, resources: I64, options: FusionOptions) -> SceneDepth:
        """Measure the depth of resources (rows) in the range of the options; 0 where there is none."""
        some = resources[:: -(-len(resources) // _LOOKED_AT)].tolist()
        values = np.concatenate([depth.view(row)[0].ravel() for row in some])
        used = values[(values >= options.min_ray_length_m) & (values <= options.max_ray_length_m)]
        return cls(
            float(np.median(used)) if len(used) else 0.0,
            len(used) / max(int(np.count_nonzero(values)), 1),
        )


def grid_settings(options: FusionOptions, scene: SceneDepth) -> GridSettings:
    """Return the settings of a grid that options describe, with voxels that suit the depth of a scene."""
    fitting_m = scene.median_m / _VOXELS_IN_DEPTH
    chosen_m = max((m for m in _VOXELS_M if m <= fitting_m), default=_VOXELS_M[0])
    voxel_m = options.voxel_size_m or chosen_m
    return GridSettings(
        voxel_m,
        options.truncation_distance_m or 3.0 * voxel_m,
        options.min_ray_length_m,
        options.max_ray_length_m,
        options.weight_depth_power,
        options.max_weight,
    )


def fuse_views(
    depth: DepthViews,
    resources: I64,
    poses: F64,
    settings: GridSettings,
    progress: Progress,
    *,
    with_free_space: bool = False,
) -> TsdfGrid:
    """Fuse depth into a grid.

    Args:
        depth: Depth of frames.
        resources: Rows (K,) of the resources.
        poses: Poses (K, 7) of their cameras in the frame of the grid.
        with_free_space: The grid also has the space between cameras and surfaces.

    Raises:
        MapError: A file is missing, damaged, or of another size than the camera's images.
        EstimationError: There is no depth in the range of the settings.
        NotEnoughMemory: The grid exceeds the allowed memory.
    """
    count = len(resources)
    views = depth.views(resources, poses, progress, "making the blocks of the grid")
    blocks = blocks_of_views(views, settings, with_free_space=with_free_space)
    if not len(blocks):
        raise EstimationError(
            f"{counted(count, 'depth map')} without any depth from {settings.min_depth_m:g} m to "
            f"{settings.max_depth_m:g} m: choose another --dense_tsdf_min_ray_length_m or "
            "--dense_tsdf_max_ray_length_m"
        )
    grid = TsdfGrid.unobserved(settings, blocks)
    for view in depth.views(resources, poses, progress, "fusing depth"):
        grid.integrate(*view)
    return grid


def depth_type(vi_map: VIMap, missions: I64, given: int | None) -> int:
    """Return the resource type of depth to fuse.

    Raises:
        UserError: There is none, or the given type is no depth.
    """
    if given is not None and given not in (*DEPTH_MAPS, *CLOUDS):
        known = ", ".join(str(kind) for kind in (*DEPTH_MAPS, *CLOUDS))
        raise UserError(f"--dense_depth_resource_input_type={given}: wants one of {known}")
    wanted = _INPUT_TYPES if given is None else (given,)
    for kind in wanted:
        if resources_of(vi_map, (kind,), missions).any():
            return kind
    what = "depth" if given is None else resource_type(given).name
    raise UserError(
        f"the missions have no {what}: stereo_dense_reconstruction makes depth maps",
        remedy="stereo_dense_reconstruction",
    )


def mission_groups(vi_map: VIMap, missions: I64) -> tuple[list[list[int]], list[str]]:
    """Group missions in a common frame: those with known base frames; each other one is alone."""
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe[missions]]
    together = missions[known].tolist()
    alone = [[row] for row in missions[~known].tolist()]
    notes = []
    if len(missions) > 1 and alone:
        names = ", ".join(short_id(vi_map, group[0]) for group in alone)
        notes.append(f"missions with unknown base frames have grids of their own: {names}")
    return ([together] if together else []) + alone, notes


def short_id(vi_map: VIMap, mission: int) -> str:
    """Return the beginning of a mission's id."""
    return to_hex(vi_map.missions.id[mission])[:8]


class DepthViews:
    """Depth of frames as depth maps of perspective cameras."""

    def __init__(self, vi_map: VIMap, map_folder: Path, kind: int) -> None:
        """Serve the depth resources of a type (number)."""
        self.kind = kind
        self._resources = FrameResources(vi_map, map_folder)
        self._cameras: dict[str, tuple[Pinhole, ImageMap]] = {}

    def of_missions(self, missions: list[int]) -> I64:
        """Return the rows of the depth resources of missions, by mission and time of the frame."""
        vi_map = self._resources.vi_map
        rows = np.flatnonzero(resources_of(vi_map, (self.kind,), np.array(missions)))
        if (vi_map.resources.owner_kind[rows] != ResourceOwner.FRAME).any():
            raise UserError(
                f"resources of type {resource_type(self.kind).name} belong to sensors: only depth of "
                "cameras can be fused; choose another --dense_depth_resource_input_type"
            )
        return rows[np.argsort(vi_map.resources.owner[rows], kind="stable")]

    def poses(self, rows: I64, T_M_G: F64) -> F64:
        """Return the poses T_M_C (N, 7) of depth resources."""
        owners = self._resources.vi_map.resources.owner[rows].tolist()
        return se3.compose(T_M_G, np.stack([self._resources.T_G_C(frame) for frame in owners]))

    def views(self, rows: I64, T_M_C: F64, progress: Progress, what: str) -> Iterator[View]:
        """Yield the depth maps of resources with the poses (N, 7) of their cameras."""
        for done, (row, T) in enumerate(zip(rows.tolist(), se3.to_matrix(T_M_C), strict=True)):
            progress.step(done, len(rows), what)
            yield *self.view(row), T

    def view(self, row: int) -> tuple[F32, Pinhole]:
        """Return a depth map (H, W) [m] of a perspective camera, and the camera."""
        camera = self._resources.camera(int(self._resources.vi_map.resources.owner[row]))
        if camera.id not in self._cameras:
            self._cameras[camera.id] = undistorted(camera)
        pinhole, image_map = self._cameras[camera.id]
        if self.kind in DEPTH_MAPS:
            depth = self._resources.depth(row)
        else:
            name = f"cloud {to_hex(self._resources.vi_map.resources.id[row])}"
            depth = depth_of_cloud(camera, parse_ply(self._resources.content(row), name).p)
        return image_map.depth(depth), pinhole
