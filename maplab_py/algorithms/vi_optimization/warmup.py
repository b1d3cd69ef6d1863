"""Compile the kernels of the optimiser by running each once on a tiny problem."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np

from maplab_py.estimation.camera_terms import CalibratingVisualTerms, camera_blocks
from maplab_py.estimation.codegen.kernels import (
    calibrating_kernels,
    residual_kernel,
    visual_kernels,
)
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.states import States
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.visual_terms import Cameras, Observations, VisualTerms
from maplab_py.geometry import se3
from maplab_py.sensors import Distortion, Imu, Projection
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE

_FACTORS = {  # name: its source, inputs, residual size, Jacobian columns
    "inertial": (sources.inertial, 100, 9, 24),
    "inertial_with_intrinsics": (sources.inertial_with_intrinsics, 235, 9, 39),
    "relative_pose": (sources.relative_pose, 28, 6, 12),
    "relative_pose_with_mounting": (sources.relative_pose_with_mounting, 28, 6, 18),
    "switched_relative_pose": (sources.switched_relative_pose, 24, 6, 15),
    "absolute_pose": (sources.absolute_pose, 21, 6, 6),
    "absolute_pose_with_mounting": (sources.absolute_pose_with_mounting, 21, 6, 12),
}


def optimizer_jobs() -> dict[str, Callable[[], None]]:
    """Return by name what compiles one kernel each."""
    jobs: dict[str, Callable[[], None]] = {name: partial(_run_factor, name) for name in _FACTORS}
    jobs["block Cholesky"] = _run_linear
    jobs["preintegration"] = _run_integration
    for projection, distortion in itertools.product(Projection, Distortion):
        model = f"{projection.name} {distortion.name}"
        run = partial(_run_visual, projection, distortion)
        jobs[f"reprojection {model}"] = partial(run, calibrating=False)
        jobs[f"camera calibration {model}"] = partial(run, calibrating=True)
    return jobs


def _run_factor(name: str) -> None:
    source, inputs, size, columns = _FACTORS[name]
    residual_kernel(name, source).evaluate(
        np.ones((1, inputs)), np.eye(size)[None], np.empty((1, size)), np.empty((1, size, columns))
    )


def _run_visual(
    projection: Projection,
    distortion: Distortion,
    *,
    calibrating: bool,
) -> None:
    intrinsics = [0.1, 100.0, 100.0, 50.0, 50.0][5 - INTRINSICS_SIZE[projection] :]
    parameters = np.array([[0.0, *intrinsics, *[0.1] * DISTORTION_SIZE[distortion]]])
    T_G_I = se3.identity(2)
    T_G_I[1, 4] = 1.0
    p_G = np.array([[0.5, 0.0, 5.0]])
    observations = Observations(
        start=np.array([0, 2], dtype=np.int64),
        vertex=np.array([0, 1], dtype=np.int32),
        camera=np.zeros(2, dtype=np.int32),
        uv_px=np.array([[60.0, 50.0], [40.0, 50.0]]),
        inverse_sigma=np.ones(2),
        loss_scale=np.full(2, 3.0),
    )
    cameras, zero = Cameras(se3.identity(1), parameters), np.zeros((2, 3))
    states = States(T_G_I, zero, zero, zero, p_G)
    models = ((projection, distortion),)
    if calibrating:
        states = states.with_blocks(*camera_blocks(cameras, np.zeros(1)))
        own = calibrating_kernels(models)
        visual: VisualTerms = CalibratingVisualTerms(own, observations, cameras, 2)
        assert isinstance(visual, CalibratingVisualTerms)
        visual.follow_motion(zero)
        visual.refresh(states)
    else:
        visual = VisualTerms(visual_kernels(models), observations, cameras, 2)
    visual.node_system(states, 1e-4, np.empty((len(visual.block_nodes(states)[0]), 3, 3)))
    visual.take_step(states, np.zeros((states.num_nodes, 3)), states, 1e-4)
    visual.errors(states)


def _run_linear() -> None:
    solver = BlockCholesky(np.array([0, 1, 1]), np.array([0, 0, 1]), 2, 3)
    solver.factor(np.stack([4.0 * np.eye(3), np.eye(3), 4.0 * np.eye(3)]))
    solver.solve(np.ones(6))


def _run_integration() -> None:
    data = InertialData(
        sample_start=np.array([0, 3], dtype=np.int64),
        timestamp_ns=np.array([0, 5_000_000, 10_000_000], dtype=np.int64),
        accel_gyro=np.tile([0.0, 0.0, 9.81, 0.0, 0.0, 0.1], (3, 1)),
        imus=(Imu(id="0" * 32),),
        imu_of_edge=np.zeros(1, dtype=np.int64),
    )
    for with_intrinsics in (False, True):
        integrate(data, np.zeros(3), np.zeros(3), with_intrinsics=with_intrinsics)
