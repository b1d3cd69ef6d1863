"""Poses of the cameras of all frames, as matrices."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.estimation.kernels import window as kernels

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
