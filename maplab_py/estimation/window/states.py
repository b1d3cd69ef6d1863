"""The states of a window, an immutable value; a step returns new states."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.geometry import se3


@dataclasses.dataclass(frozen=True, eq=False)
class WindowStates:
    """F frames in the order of time, and L landmarks in the cameras of their anchors.

    A window that is localised in a map has a base frame T_G_M and estimates A landmarks of the map.
    """

    T_M_I: F64  # (F, 7)
    motion: F64  # (F, 9) velocity v_M, gyroscope bias, accelerometer bias
    h: F64  # (L, 3) [x/z, y/z, 1/z]
    T_G_M: F64 = dataclasses.field(default_factory=lambda: np.zeros((0, 7)))  # (B, 7), B = 0 or 1
    p_G: F64 = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))  # (A, 3)
    calibration: F64 = dataclasses.field(default_factory=lambda: np.zeros(0))  # (K,) of the cameras

    def __len__(self) -> int:
        return len(self.T_M_I)

    @property
    def gyro_bias(self) -> F64:
        """Gyroscope biases (F, 3) [rad/s]."""
        return self.motion[:, 3:6]

    @property
    def accel_bias(self) -> F64:
        """Accelerometer biases (F, 3) [m/s^2]."""
        return self.motion[:, 6:9]

    def moved(self, step: F64, h: F64) -> WindowStates:
        """Apply tangent vectors (15 F + K + 6 B,) and take landmarks h; those of the map stay.

        Tangents are, by frame, [p, theta, v, b_g, b_a], then those of the calibration and, of the base
        frame, [p, theta].
        """
        T_M_I, motion = np.empty_like(self.T_M_I), np.empty_like(self.motion)
        kernels.retract(self.T_M_I, self.motion, step, T_M_I, motion)
        first = FRAME_SIZE * len(self)
        calibration = self.calibration + step[first : first + len(self.calibration)]
        return WindowStates(T_M_I, motion, h, self._moved_base(step), self.p_G, calibration)

    def offsets(self, origin: WindowStates) -> F64:
        """Return the tangent vectors (15 F + K + 6 B,) from other states to these."""
        of_frames, count = FRAME_SIZE * len(self), len(self.calibration)
        result = np.zeros(of_frames + count + 6 * len(self.T_G_M))
        kernels.offsets(self.T_M_I, self.motion, origin.T_M_I, origin.motion, result)
        if count:
            result[of_frames : of_frames + count] = self.calibration - origin.calibration
        if len(origin.T_G_M):
            result[-6:] = se3.local(origin.T_G_M[0], self.T_G_M[0])
        return result

    def _moved_base(self, step: F64) -> F64:
        if not len(self.T_G_M):
            return self.T_G_M
        return se3.retract(self.T_G_M, step[-6:][None])

    def with_frame(self, T_M_I: F64, motion: F64) -> WindowStates:
        """Return the states with a later frame (7,), (9,)."""
        return dataclasses.replace(
            self,
            T_M_I=np.concatenate([self.T_M_I, T_M_I[None]]),
            motion=np.concatenate([self.motion, motion[None]]),
        )

    def without_frame(self, frame: int) -> WindowStates:
        """Return the states without a frame; landmarks keep their anchors' numbers."""
        return dataclasses.replace(
            self,
            T_M_I=np.delete(self.T_M_I, frame, axis=0),
            motion=np.delete(self.motion, frame, axis=0),
        )

    def size(self) -> float:
        """Return the norm of all values, for the relative size of a step."""
        parts = (self.T_M_I, self.motion, self.h, self.T_G_M, self.p_G, self.calibration)
        return float(np.sqrt(sum(np.vdot(part, part) for part in parts)))


def scale_sigma(p_M: F64, covariance: F64) -> float:
    """Return the standard deviation of the scale of positions (F, 3), as a share of it.

    It is that of a similarity alignment with the true positions: of s = sum q_i . p_i / sum q_i . q_i with
    offsets q_i from the mean, to first order (S. Umeyama, PAMI 1991, equation 42). A single distance would
    count the noise of two positions instead of all.

    Args:
        p_M: Positions.
        covariance: Of all states (15 F, 15 F), which begin with the positions.
    """
    offset = p_M - p_M.mean(axis=0)
    weight = np.zeros((len(p_M), FRAME_SIZE))
    weight[:, :3] = offset / max(float(np.vdot(offset, offset)), 1e-12)
    by_state = weight.ravel()
    return float(np.sqrt(max(float(by_state @ covariance @ by_state), 0.0)))
