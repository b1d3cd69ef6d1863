"""Compile the kernels of the window by running each once on a tiny window."""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.estimation.codegen.kernels import residual_kernel, window_kernels
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.kernels.window_arguments import (
    FRAME_SIZE,
    DenseSystem,
    Elimination,
    WindowData,
    WindowPoint,
    WindowRule,
)
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.window import cameras, inertial, map_terms
from maplab_py.estimation.window.calibration import FrameTimes, WindowCalibration
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3
from maplab_py.sensors import Camera, Distortion, Imu, Projection


def window_jobs() -> dict[str, Callable[[], None]]:
    """Return functions by name, each of which compiles a kernel."""
    jobs: dict[str, Callable[[], None]] = {"window": _run_frames}
    jobs["window landmarks"] = _run_landmarks
    return jobs


def _states() -> WindowStates:
    T_M_I = se3.identity(2)
    T_M_I[1, 4] = 0.5
    return WindowStates(T_M_I, np.zeros((2, 9)), np.array([[0.1, 0.0, 0.2]]))


def _camera() -> Camera:
    return Camera(
        "0" * 32, Projection.PINHOLE, Distortion.NONE, np.full(4, 50.0), np.zeros(0), 100, 100
    )


def _run_landmarks() -> None:
    camera = _camera()
    calibration = WindowCalibration.of((camera,), se3.identity(1))
    module, states = window_kernels(), _states()
    frame, row = np.array([0, 1], dtype=np.int32), np.zeros(2, dtype=np.int32)
    uv = np.array([[60.0, 50.0], [50.0, 50.0]])
    data = WindowData(
        np.array([0, 2], dtype=np.int64),
        frame,
        row,
        uv,
        np.ones(2),
        np.ones(2),
        row[:1],
        row[:1],
        np.zeros((1, 2)),
    )
    twist = FrameTimes(np.zeros((2, 3)), np.zeros(2)).twist(states)
    at = WindowPoint(states.T_M_I, states.h, calibration.of_kernels(np.zeros(0)), twist)
    rule = WindowRule(int(Loss.HUBER), 1e-5, states.T_M_I, np.array([True, False]))
    system, kept = DenseSystem.zeros(2 * FRAME_SIZE), Elimination.empty(1, 2)
    module.eliminate(data, at, rule, system, kept)
    new = at._replace(h=np.empty_like(states.h))
    module.substitute(data, at, rule, kept, np.zeros(2 * FRAME_SIZE), new)
    module.evaluate(data, at, np.empty((2, 2)))
    cameras.BackProjection(module, calibration).rays(row, uv)


def _run_map() -> None:
    """Compile what all observations of a map need, whatever the camera."""
    states, system = _states(), DenseSystem.zeros(2 * FRAME_SIZE + 6)
    nothing = np.zeros(0, dtype=np.int32)
    observations = map_terms.MapObservations(
        np.zeros(1, dtype=np.int64), nothing, nothing, np.zeros((0, 2)), np.zeros(0),
        np.zeros((0, 3)), None,
    )  # fmt: skip
    localized = dataclasses.replace(states, T_G_M=se3.identity(1))
    terms = map_terms.MapTerms(observations, (_camera(),), se3.identity(1), huber_sigmas=1.0)
    terms.add_to(system, localized, localized)


def _run_frames() -> None:
    states, system = _states(), DenseSystem.zeros(2 * FRAME_SIZE)
    first_row = np.zeros(1, dtype=np.int64)
    kernels.add_factors(np.ones((1, 3)), np.ones((1, 3, 3)), first_row, system)
    kernels.add_walks(states.motion, np.ones((1, 2)), system)
    states.moved(states.offsets(states), states.h)
    cameras.CameraPoses.of(states.T_M_I, se3.identity(1))
    origin, start = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([0, 2], dtype=np.int64)
    ray = np.array([[0.0, 0.0, 1.0], [-0.6, 0.0, 0.8]])
    kernels.triangulate(origin, ray, start, np.empty((1, 3)), np.empty(1, dtype=np.bool_))
    chain = inertial.InertialChain(residual_kernel("inertial", sources.inertial), Imu("0" * 32))
    chain.append(1_000_000 * np.arange(2), np.ones((2, 6)), states.motion[0], is_resting=False)
    chain.relinearize(states.motion)
    kernels.group(start, start[:1], 3, start.copy(), start.copy())
    _run_map()
