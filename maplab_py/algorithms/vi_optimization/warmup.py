"""Compile the kernels of optimiser and place recognition by running each once on tiny problems."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor, wait

import numpy as np

from maplab_py.estimation.camera_terms import CalibratingVisualTerms, camera_blocks
from maplab_py.estimation.codegen.kernels import (
    calibrating_kernels,
    residual_kernel,
    visual_kernels,
)
from maplab_py.estimation.codegen.modules import cache_folder
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.states import States
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.visual_terms import Cameras, Observations, VisualTerms
from maplab_py.geometry import se3
from maplab_py.progress import Progress
from maplab_py.sensors import Distortion, Imu, Projection
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE
from maplab_py.vision.warmup import compile_poses, compile_search

_FACTORS = {  # name: its source, inputs, residual size, Jacobian columns
    "inertial": (sources.inertial, 100, 9, 24),
    "inertial_with_intrinsics": (sources.inertial_with_intrinsics, 235, 9, 39),
    "relative_pose": (sources.relative_pose, 28, 6, 12),
    "relative_pose_with_mounting": (sources.relative_pose_with_mounting, 28, 6, 18),
    "switched_relative_pose": (sources.switched_relative_pose, 24, 6, 15),
    "absolute_pose": (sources.absolute_pose, 21, 6, 6),
    "absolute_pose_with_mounting": (sources.absolute_pose_with_mounting, 21, 6, 12),
}


_LINEAR, _INTEGRATION = "block Cholesky", "preintegration"
_REPROJECTION, _CALIBRATION = "reprojection", "camera calibration"
_RECOGNITION = {"descriptor search": compile_search, "absolute pose": compile_poses}


def compile_kernels(progress: Progress) -> tuple[list[str], float, str]:
    """Compile all kernels; return their names, the time it took [s], and the cache folder.

    Several processes compile at a time; what they make is shared through the cache folder.
    """
    began = time.perf_counter()
    jobs = [*_FACTORS, _LINEAR, _INTEGRATION, *_RECOGNITION]
    for projection, distortion in itertools.product(Projection, Distortion):
        model = f"{projection.name} {distortion.name}"
        jobs += [f"{_REPROJECTION} {model}", f"{_CALIBRATION} {model}"]
    workers = min(len(jobs), os.cpu_count() or 1)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        pending = {pool.submit(_compile, job) for job in reversed(jobs)}
        try:
            while pending:
                progress.step(len(jobs) - len(pending), len(jobs), "compile kernels")
                done, pending = wait(pending, timeout=0.2)
                for future in done:
                    future.result()
        finally:
            for future in pending:
                future.cancel()
    progress.step(len(jobs), len(jobs), "compile kernels")
    return [job.lower() for job in jobs], time.perf_counter() - began, str(cache_folder())


def _compile(job: str) -> None:
    """Compile one kernel, in a process of its own."""
    if job in _FACTORS:
        source, inputs, size, columns = _FACTORS[job]
        kernel = residual_kernel(job, source)
        kernel.evaluate(
            np.ones((1, inputs)), np.eye(size)[None], np.empty((1, size)),
            np.empty((1, size, columns)),
        )  # fmt: skip
    elif job in _RECOGNITION:
        _RECOGNITION[job]()
    elif job == _LINEAR:
        _run_linear()
    elif job == _INTEGRATION:
        _run_integration()
    else:
        kind, projection, distortion = job.rsplit(" ", 2)
        is_calibrating = kind == _CALIBRATION
        _run_visual(Projection[projection], Distortion[distortion], calibrating=is_calibrating)


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
