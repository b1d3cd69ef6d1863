"""How noisy the samples of an IMU are, by their residuals: data sheets leave out vibrations."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.window.inertial import InertialChain
from maplab_py.estimation.window.states import WindowStates
from maplab_py.sensors import Imu

_LEAST_REDUNDANCY = 5.0
_LARGEST_FACTOR = 2.0
_COLUMNS = FRAME_SIZE + 9


def with_least_noise(imu: Imu, gyro_density: float, accel_density: float) -> Imu:
    """Return an IMU with densities that are these [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)] or more."""
    return dataclasses.replace(
        imu,
        gyro_noise_density=max(imu.gyro_noise_density, gyro_density),
        acc_noise_density=max(imu.acc_noise_density, accel_density),
    )


def noise_factor(chain: InertialChain, states: WindowStates, covariance: F64) -> float:
    """Return how many times as large as assumed the noise of the samples seems to be.

    It is the root of the weighted sum of squared residuals of the inertial edges over their redundancy, which
    is the number of residuals without those that the states follow. Noise of the images draws it towards 1.
    Source: W. Foerstner, B. Wrobel, Photogrammetric Computer Vision, 2016, section 4.2.4.

    Args:
        chain: The edges between frames.
        states: States of the frames at the optimum.
        covariance: Of them (15 F, 15 F).
    """
    residual, jacobian = chain.evaluate(states.T_M_I, states.motion, slice(None))
    rows = FRAME_SIZE * np.arange(len(residual))[:, None] + np.arange(_COLUMNS)
    of_edges = covariance[rows[:, :, None], rows[:, None, :]]  # (E, 24, 24)
    followed = np.einsum("eij,ejk,eik->", jacobian, of_edges, jacobian, optimize=True)
    redundancy = residual.size - float(followed)
    if redundancy < _LEAST_REDUNDANCY:
        return 1.0
    return min(float(np.sqrt(np.vdot(residual, residual) / redundancy)), _LARGEST_FACTOR)
