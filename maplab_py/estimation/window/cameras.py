"""Cameras of a window: rays of pixels, and poses of the cameras of all frames."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I32, Mask, NDArray
from maplab_py.estimation.kernels import window as kernels
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


Rows = NDArray[np.integer]


@dataclasses.dataclass(frozen=True, eq=False)
class CameraPoses:
    """Rotations and positions of C cameras in F frames."""

    R_M_C: F64  # (F, C, 3, 3)
    p_M_C: F64  # (F, C, 3)

    @classmethod
    def of(cls, T_M_I: F64, T_I_C: F64) -> CameraPoses:
        """Compose poses (F, 7) of frames with those (C, 7) of the cameras on the IMU."""
        shape = len(T_M_I), len(T_I_C), 3
        poses = cls(np.empty((*shape, 3)), np.empty(shape))
        kernels.camera_poses(T_M_I, T_I_C, poses.R_M_C, poses.p_M_C)
        return poses

    def to_mission(self, frame: Rows, camera: Rows, p_C: F64) -> F64:
        """Return points (N, 3), given in cameras of frames (N,), in M."""
        turned = (self.R_M_C[frame, camera] @ p_C[:, :, None])[:, :, 0]
        return np.asarray(turned + self.p_M_C[frame, camera])

    def to_camera(self, frame: Rows, camera: Rows, p_M: F64) -> F64:
        """Return points (N, 3) in cameras of frames (N,)."""
        shifted = (p_M - self.p_M_C[frame, camera])[:, None]
        return np.asarray((shifted @ self.R_M_C[frame, camera])[:, 0])

    def rays(self, frame: Rows, camera: Rows, ray_C: F64) -> F64:
        """Return directions (N, 3), given in cameras of frames (N,), in M."""
        return np.asarray((self.R_M_C[frame, camera] @ ray_C[:, :, None])[:, :, 0])
