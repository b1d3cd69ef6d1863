"""Rays of pixels, for all cameras of a window."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I32, Mask
from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.sensors.distortion import largest_radius


class BackProjection:
    """Rays of pixels, by the kernels that differentiate the camera models."""

    def __init__(self, kernels: ModuleType, calibration: WindowCalibration) -> None:
        """Take the kernels of the template `window`, and the cameras at their reference."""
        self._kernels, cameras = kernels, calibration.cameras
        self.parameters = calibration.table  # (C, 1 + widest)
        pinhole = np.array([camera.intrinsics[-4:] for camera in cameras])
        self._focal, self._centre = pinhole[:, :2], pinhole[:, 2:]
        self._limit = np.array(
            [largest_radius(camera.distortion, camera.distortion_parameters) for camera in cameras]
        )

    def rays(self, camera: I32, uv_px: F64) -> tuple[F64, Mask]:
        """Return unit rays (N, 3) of pixels (N, 2) in their cameras (N,), and whether they exist."""
        uv = np.ascontiguousarray(uv_px, dtype=np.float64)
        xy = (uv - self._centre[camera]) / self._focal[camera]
        self._kernels.unproject(camera, uv, self.parameters, xy)
        ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        length = np.sqrt(np.sum(ray * ray, axis=1))
        valid = np.hypot(xy[:, 0], xy[:, 1]) < self._limit[camera]
        return ray / length[:, None], np.asarray(valid & np.isfinite(length))
