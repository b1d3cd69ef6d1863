"""A window expressed with another calibration of its sensors.

Relative poses of the cameras, which images determine, and the newest pose of the IMU do not change; the
other states follow from both. Biases change such that corrected samples stay the same. The marginal prior
is transformed to the new states, and inflated where the old calibration may have distorted it.
"""

import dataclasses
from typing import Self

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE, WindowCameras
from maplab_py.estimation.window.prior import WindowPrior, schur_complement
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3, so3

_GRAVITY_MPS2 = 9.81
_NOTHING = 1e-9
_FREE, _HERE = 10.0, 1e-4
"""Deviations [m], [rad] of a place and heading that are unknown, and that are taken as they are."""
_RATE_RADPS = 0.3
"""Usual rate of turns, of which an error of the gyroscope's scale makes one of its bias."""


@dataclasses.dataclass(frozen=True, eq=False)
class WindowChange:
    """Change of a calibration, as the states of a window see it."""

    T_old_new: F64  # (7,) by which poses of the IMU change so that camera 0 stays
    correction: tuple[F64, F64]  # old (2, 3, 3) and new: of gyroscope and accelerometer
    size: float  # turns of the mounting and in a delay, and largest relative changes

    @classmethod
    def between(cls, before: tuple[WindowCameras, F64], after: tuple[WindowCameras, F64]) -> Self:
        """Compare the cameras, and the corrections (2, 3, 3) of the IMU, before and after."""
        (old, of_old), (new, of_new) = before, after
        T_old_new = se3.compose(old.T_I_C[0], se3.inverse(new.T_I_C[0]))
        turn = float(np.linalg.norm(so3.log(T_old_new[:4])))
        relative = np.abs(new.parameters - old.parameters) / np.maximum(abs(old.parameters), 0.1)
        size = turn + float(relative.max()) + float(np.abs(of_new - of_old).max())
        size += _RATE_RADPS * float(np.abs(new.timing_s - old.timing_s)[:, 0].max())
        return cls(T_old_new, (of_old, of_new), size)

    def states(self, states: WindowStates, rate_I: F64, mean: F64) -> WindowStates:
        """Return the states with the new calibration.

        Args:
            states: With the old one.
            rate_I: Rates (F, 3) of the body as measured.
            mean: Mean (2, 3) of the samples of gyroscope and accelerometer.
        """
        turned = se3.compose(states.T_M_I, self.T_old_new)
        T_new_old = self._moved_frame(states)
        v_M = states.motion[:, :3] + so3.rotate(
            states.T_M_I[:, :4], np.cross(rate_I - states.gyro_bias, self.T_old_new[4:])
        )
        motion = np.concatenate(
            [
                so3.rotate(T_new_old[:4], v_M),
                self._bias(0, states.gyro_bias, mean[0]),
                self._bias(1, states.accel_bias, mean[1]),
            ],
            axis=1,
        )
        return dataclasses.replace(states, T_M_I=se3.compose(T_new_old, turned), motion=motion)

    def _moved_frame(self, states: WindowStates) -> F64:
        """Return the motion (7,) of M by which the newest pose stays as it was."""
        newest = states.T_M_I[-1]
        return se3.compose(newest, se3.inverse(se3.compose(newest, self.T_old_new)))

    def _bias(self, row: int, bias: F64, mean: F64) -> F64:
        """Return biases (F, 3) that keep the corrected mean sample."""
        old, new = (correction[row] for correction in self.correction)
        return np.asarray(mean - np.linalg.solve(new, old @ (mean - bias).T).T)

    def prior(
        self, prior: WindowPrior, states: WindowStates, rate_I: F64, mean: F64
    ) -> WindowPrior:
        """Return the prior of the new states, for the window's states before the change."""
        T_new_old = self._moved_frame(states)
        at = prior.x0.with_frame(states.T_M_I[-1], states.motion[-1])
        moved = self.states(at, np.concatenate([rate_I, rate_I[-1:]]), mean)
        root = prior.root.copy()
        R_M, R_I = so3.to_matrix(T_new_old[:4]), so3.to_matrix(self.T_old_new[:4])
        for frame in np.flatnonzero(prior.touched):
            slope = np.eye(FRAME_SIZE)
            R_M_I = so3.to_matrix(prior.x0.T_M_I[frame, :4])
            slope[:3, :3] = slope[6:9, 6:9] = R_M
            slope[:3, 3:6] = -R_M @ R_M_I @ so3.skew(self.T_old_new[4:])
            slope[3:6, 3:6] = R_I.T
            columns = slice(FRAME_SIZE * frame, FRAME_SIZE * (frame + 1))
            root[:, columns] = root[:, columns] @ np.linalg.inv(slope)
        result = dataclasses.replace(prior, root=root, x0=moved.without_frame(len(prior.x0)))
        return self._doubted(result, states.T_M_I[-1])

    def _doubted(self, prior: WindowPrior, newest: F64) -> WindowPrior:
        """Return a prior in which biases, tilt and scale may be wrong in all frames alike.

        Place and heading, which nothing shows, are those of the newest frame from now on.

        Args:
            prior: Of the new states.
            newest: Pose (7,) of the newest frame.
        """
        if self.size < _NOTHING:
            return prior
        scales = (_RATE_RADPS, _GRAVITY_MPS2, 1.0)
        sigma = np.concatenate([self.size * np.repeat(scales, 3), [_FREE] * 4])
        x0 = prior.x0
        way = np.zeros((len(x0), FRAME_SIZE, 13))
        way[:, 9:15, :6] = np.eye(6)
        offset, v_M = x0.T_M_I[:, 4:] - newest[4:], x0.motion[:, :3]
        turns = [6, 7, 12]  # about the axes of M
        way[:, :3, turns] = np.cross(np.eye(3), offset[:, None]).transpose(0, 2, 1)
        way[:, 3:6, turns] = so3.to_matrix(x0.T_M_I[:, :4]).transpose(0, 2, 1)
        way[:, 6:9, turns] = np.cross(np.eye(3), v_M[:, None]).transpose(0, 2, 1)
        way[:, :3, 8], way[:, 6:9, 8] = offset, v_M
        way[:, :3, 9:12] = np.eye(3)
        root = np.concatenate([prior.root, -prior.root @ way.reshape(-1, 13)], axis=1)
        information, count = root.T @ root, prior.root.shape[1]
        information[count:, count:] += np.diag(sigma**-2.0)
        information, gradient = schur_complement(
            information, root.T @ prior.residual, count + np.arange(13)
        )
        here = np.zeros((4, count))
        here[:3, -FRAME_SIZE : 3 - FRAME_SIZE] = np.eye(3)
        here[3, 3 - FRAME_SIZE : 6 - FRAME_SIZE] = so3.to_matrix(newest[:4])[2]
        information += here.T @ here / _HERE**2
        T_M_I = np.concatenate([x0.T_M_I[:-1], newest[None]])
        x0 = dataclasses.replace(x0, T_M_I=T_M_I)
        return WindowPrior.of_information(information, gradient, x0, prior.is_fixed)
