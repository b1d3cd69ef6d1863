"""Analytic motions with their exact IMU readings."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.geometry import so3
from maplab_py.sensors import Imu

F64 = NDArray[np.float64]
GRAVITY = np.array([0.0, 0.0, -9.81])


def angular_velocity(t: F64) -> F64:
    """Angular velocity in the body frame (..., 3) [rad/s] at times t (...)."""
    return np.stack([0.9 * np.sin(1.3 * t), 0.7 * np.cos(0.9 * t + 0.2), 0.4 + 0.5 * t], axis=-1)


def specific_force(t: F64) -> F64:
    """Specific force in the body frame (..., 3) [m/s^2] at times t (...)."""
    return np.stack([1.5 * np.sin(2.0 * t), 0.8 * np.cos(1.1 * t), 9.81 + np.sin(1.7 * t)], axis=-1)


def truth(seconds: float) -> tuple[F64, F64, F64]:
    """Integrate the motion from rest at the origin without gravity: dR (4,), dv (3,), dp (3,)."""
    from scipy.integrate import solve_ivp

    def derivative(t, y):
        q = y[:4]
        spin = np.append(angular_velocity(np.array(t)), 0.0)
        force = so3.rotate(so3.normalize(q), specific_force(np.array(t)))
        return np.concatenate([0.5 * so3.multiply(q, spin), force, y[4:7]])

    start = np.concatenate([[0, 0, 0, 1.0], np.zeros(6)])
    end = solve_ivp(derivative, (0, seconds), start, method="DOP853", rtol=1e-12, atol=1e-13).y
    return so3.normalize(end[:4, -1]), end[4:7, -1], end[7:, -1]


def sampled(seconds: float, rate_hz: float) -> tuple[NDArray[np.int64], F64]:
    """Return times (N,) [ns] and exact readings (N, 6) of the motion."""
    count = round(seconds * rate_hz)
    stamps = np.round(np.linspace(0, seconds, count + 1) * 1e9).astype(np.int64)
    t = stamps * 1e-9
    return stamps, np.concatenate([specific_force(t), angular_velocity(t)], axis=1)


def one_edge(stamps: NDArray[np.int64], readings: F64, imu: Imu | None = None) -> InertialData:
    """Make an edge of all samples."""
    return InertialData.of_samples(imu or Imu("0" * 32), [(stamps, readings)])
