"""Rays of pixels by cubic splines: a tenth of the time of inverting the camera model."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project

_STEP_PX = 8.0
"""Distance of the nodes; the error grows with its fourth power (1e-4 px for EuRoC's cameras)."""
_BORDER_PX = 16.0


@dataclasses.dataclass(frozen=True, eq=False)
class RayTable:
    """Rays of a camera, exact to a thousandth of a pixel, inside its image."""

    camera: Camera
    splines: tuple[
        Any, ...
    ]  # x, y, z of the ray; none where the model cannot be inverted everywhere

    @classmethod
    def of(cls, camera: Camera) -> RayTable:
        """Invert the camera model at the nodes of a grid."""
        from scipy.interpolate import RectBivariateSpline

        u, v = (
            np.arange(-_BORDER_PX, size + _BORDER_PX + _STEP_PX, _STEP_PX)
            for size in (camera.width_px, camera.height_px)
        )
        nodes = np.stack(np.meshgrid(u, v), axis=-1)
        ray, exists = back_project(camera, nodes)
        if not exists.all():
            return cls(camera, ())
        return cls(camera, tuple(RectBivariateSpline(v, u, ray[..., i]) for i in range(3)))

    def rays(self, uv_px: F64) -> tuple[F64, Mask]:
        """Return unit rays (K, 3) of pixels (K, 2), and whether they exist (K,)."""
        low, high = (
            -_BORDER_PX,
            np.array([self.camera.width_px, self.camera.height_px]) + _BORDER_PX,
        )
        inside = np.all((uv_px >= low) & (uv_px <= high), axis=1)
        if not self.splines or not inside.all():
            return back_project(self.camera, uv_px)
        ray = np.stack([spline.ev(uv_px[:, 1], uv_px[:, 0]) for spline in self.splines], axis=1)
        return ray / np.linalg.norm(ray, axis=1, keepdims=True), inside
