"""Arguments of the generated kernels of the window; each group is one argument.

O observations of L landmarks by F frames with C cameras. Rows of a frame in the dense system begin at
15 frame: position, orientation, velocity, gyroscope and accelerometer bias. Columns of what belongs
to no frame have their place behind those of all frames: first the K numbers of the calibration that are
estimated, then a base frame T_G_M of a localised odometry.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask

FRAME_SIZE = 15
"""Rows of a frame in the dense system."""


class WindowData(NamedTuple):
    """Observations. The anchor of a landmark is the earliest frame among its observations."""

    start: I64  # (L + 1,) offsets by landmark
    frame: I32  # (O,) ascending within a landmark
    camera: I32  # (O,)
    uv_px: F64  # (O, 2)
    inverse_sigma: F64  # (O,) [1/px]
    scale2: F64  # (O,) squared scale of the loss
    anchor_frame: I32  # (L,)
    anchor_camera: I32  # (L,)
    expected: F64  # (L, 2) 1/z that is expected, and the inverse of its deviation (0 = anything)


class WindowCameras(NamedTuple):
    """Cameras, and where the system has columns for their calibration."""

    T_I_C: F64  # (C, 7)
    parameters: F64  # (C, 1 + widest): code of the model, then intrinsics and distortion
    timing_s: (
        F64  # (C, 2) delay of the first row of an image after its stamp, time between two rows
    )
    slope: F64  # (C, 3, 3) right perturbation of R_I_C by its three states
    columns: I64  # (C, D) column of each number of a camera behind those of the frames; -1 = none


class WindowPoint(NamedTuple):
    """States at which residuals are evaluated."""

    T_M_I: F64  # (F, 7)
    h: F64  # (L, 3) [x/z, y/z, 1/z] in the camera of the anchor
    cameras: WindowCameras
    twist: (
        F64  # (F, 7) velocity and angular velocity in I, delay in the frame's time; (0, 7) = rows
    )
    # of all images have the times of their frames


class WindowRule(NamedTuple):
    """Weights and derivatives of residuals, and elimination of landmarks."""

    loss: int
    damping: float
    T_M_I: F64  # (F, 7) where Jacobians are evaluated
    is_elsewhere: Mask  # (F,) whether that is not where the frame is


class MapData(NamedTuple):
    """Observations of landmarks of a map."""

    frame: I32  # (O,) of the window
    camera: I32  # (O,)
    landmark: I64  # (O,)
    uv_px: F64  # (O, 2)
    inverse_sigma: F64  # (O,) [1/px]


class MapCameras(NamedTuple):
    """Cameras that see a map."""

    T_I_C: F64  # (C, 7)
    parameters: F64  # (C, 1 + widest), as `WindowPoint` has them
    limits: F64  # (C, 4) see `sensors.projection.visibility_limits`


class DenseSystem(NamedTuple):
    """Normal equations of all frames, n = 15 F and what follows; matrices by lower triangle."""

    matrix: F64  # (n, n) landmarks eliminated
    reduced_gradient: F64  # (n,) likewise
    gradient: F64  # (n,) of the unreduced equations
    diagonal: F64  # (n,) of the unreduced equations

    @classmethod
    def zeros(cls, size: int) -> DenseSystem:
        """Return equations of nothing."""
        return cls(np.zeros((size, size)), np.zeros(size), np.zeros(size), np.zeros(size))


class Elimination(NamedTuple):
    """Quantities kept of every landmark, to step it when the frames' steps are known."""

    num_slots: I64  # (L,) frames that the landmark touches
    slots: I32  # (L, F) those frames
    Y: F64  # (L, F, 3, 6) of each of them: L^-1 W
    Y_calibration: F64  # (L, 3, K) likewise
    factor: F64  # (L, 6) of the damped 3 x 3 matrix
    square: F64  # (L, 6) the matrix itself
    gradient: F64  # (L, 3)

    @classmethod
    def empty(cls, landmarks: int, frames: int, calibration: int = 0) -> Elimination:
        """Return room for landmarks seen by frames, and numbers of the calibration."""
        return cls(
            np.empty(landmarks, dtype=np.int64),
            np.empty((landmarks, frames), dtype=np.int32),
            np.empty((landmarks, frames, 3, 6)),
            np.empty((landmarks, 3, calibration)),
            np.empty((landmarks, 6)),
            np.empty((landmarks, 6)),
            np.empty((landmarks, 3)),
        )
