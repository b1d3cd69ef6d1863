"""Compile the optimiser's kernels by running each once on a tiny problem."""

from __future__ import annotations

import time

import numpy as np

from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.codegen.modules import cache_folder
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.symbolic.sources import absolute_pose, inertial, relative_pose
from maplab_py.estimation.visual_terms import Cameras, Observations, VisualTerms
from maplab_py.geometry import se3
from maplab_py.progress import Progress
from maplab_py.sensors import Distortion, Imu, Projection
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE

_FACTORS = {"inertial": inertial, "relative_pose": relative_pose, "absolute_pose": absolute_pose}
_ARGUMENTS = {"inertial": (100, 9, 24), "relative_pose": (28, 6, 12), "absolute_pose": (21, 6, 6)}


def compile_kernels(progress: Progress) -> tuple[list[str], float, str]:
    """Compile all kernels; return their names, the time it took [s], and the cache folder."""
    began = time.perf_counter()
    names: list[str] = []
    models = [(p, d) for p in Projection for d in Distortion]
    total = len(models) + len(_FACTORS) + 2
    for projection, distortion in models:
        progress.step(len(names), total, "compile kernels")
        _run_visual(projection, distortion, progress)
        names.append(f"reprojection {projection.value} {distortion.value}")
    for name, source in _FACTORS.items():
        progress.step(len(names), total, "compile kernels")
        inputs, size, columns = _ARGUMENTS[name]
        kernel = residual_kernel(name, source, progress)
        kernel.evaluate(
            np.ones((1, inputs)), np.eye(size)[None], np.empty((1, size)),
            np.empty((1, size, columns)),
        )  # fmt: skip
        names.append(name)
    _run_linear()
    names.append("block Cholesky")
    _run_integration()
    names.append("preintegration")
    progress.step(total, total, "compile kernels")
    return names, time.perf_counter() - began, str(cache_folder())


def _run_visual(projection: Projection, distortion: Distortion, progress: Progress) -> None:
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
    kernels = visual_kernels(((projection, distortion),), progress)
    visual = VisualTerms(kernels, observations, Cameras(se3.identity(1), parameters), 2)
    visual.linearize(T_G_I, p_G, 1e-4)
    visual.step(T_G_I, p_G, np.zeros((2, 6)), T_G_I, 1e-4)
    visual.reprojection(T_G_I, p_G)


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
    integrate(data, np.zeros(3), np.zeros(3))
