"""Depth resources of frames as depth maps of perspective cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.algorithms.dense.clouds import depth_of_cloud
from maplab_py.algorithms.dense.pinhole import ImageMap, Pinhole, undistorted
from maplab_py.algorithms.dense.resources import DEPTH_MAPS, FrameResources
from maplab_py.array_types import F32, F64, I64
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.interop.ply import parse_ply
from maplab_py.storage.resource_types import resource_type
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.resource_queries import resources_of


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
