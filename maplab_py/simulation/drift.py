"""Initial states with the drift of visual-inertial odometry in yaw, position and scale."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.geometry import se3, so3, yaw
from maplab_py.simulation.scenario import DriftOptions
from maplab_py.simulation.spline import MotionState

_TILT_TIME_S = 10.0
"""Correlation time of roll and pitch errors, which gravity bounds."""


@dataclasses.dataclass(frozen=True, eq=False)
class DriftedStates:
    """Odometry estimates at the vertices in the mission frame M."""

    T_M_I: F64  # (V, 7)
    v_M: F64  # (V, 3)


def mission_frame(T_G_I_first: F64) -> F64:
    """Return the true T_G_M (7,): M lies at the first body position, with its yaw."""
    element = yaw.from_pose(T_G_I_first)
    return yaw.to_pose(element)


def drift(
    options: DriftOptions, motion: MotionState, time_s: F64, rng: np.random.Generator
) -> DriftedStates:
    """Return drifting states of a motion that is known at vertex times (V,) [s]."""
    count = len(time_s)
    T_M_I = se3.compose(se3.inverse(mission_frame(motion.T_G_I[0])), motion.T_G_I)
    q_M_G = so3.inverse(mission_frame(motion.T_G_I[0])[:4])
    v_M = so3.rotate(q_M_G, motion.v_G)
    root = np.sqrt(np.diff(time_s))
    yaw_steps = np.deg2rad(options.yaw_walk_deg) * root * rng.standard_normal(count - 1)
    yaw_error = np.concatenate([[0.0], np.cumsum(yaw_steps)])
    scale = 1.0 + options.scale_sigma * rng.standard_normal()
    steps = scale * yaw.rotate(yaw_error[:-1], np.diff(T_M_I[:, 4:], axis=0))
    steps += options.position_walk * root[:, None] * rng.standard_normal((count - 1, 3))
    p = T_M_I[0, 4:] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    tilt = _tilt(options, time_s, rng)
    q = so3.multiply(yaw.quaternion(yaw_error), so3.multiply(tilt, T_M_I[:, :4]))
    v = scale * yaw.rotate(yaw_error, v_M)
    v += options.velocity_sigma * rng.standard_normal((count, 3))
    return DriftedStates(se3.make(so3.normalize(q), p), v)


def _tilt(options: DriftOptions, time_s: F64, rng: np.random.Generator) -> F64:
    """Return roll and pitch errors as rotations (V, 4): a stationary first-order process.

    x_k = r x_{k-1} + sqrt(1 - r^2) n_k with r = exp(-dt / tau), dt the mean time step.
    """
    from scipy.signal import lfilter

    noise = rng.standard_normal((len(time_s), 2))
    decay = np.exp(-np.mean(np.diff(time_s)) / _TILT_TIME_S)
    noise[1:] *= np.sqrt(1.0 - decay**2)
    error = np.asarray(lfilter([1.0], [1.0, -decay], noise, axis=0))
    vector = np.concatenate([error, np.zeros((len(time_s), 1))], axis=1)
    return so3.exp(np.deg2rad(options.tilt_sigma_deg) * vector)


def baseframe(options: DriftOptions, rng: np.random.Generator) -> F64:
    """Return the initial T_G_M (7,) of the map, with random yaw and position."""
    offset = rng.uniform(-options.baseframe_offset_m, options.baseframe_offset_m, 3)
    return yaw.to_pose(np.append(offset, rng.uniform(-np.pi, np.pi)))
