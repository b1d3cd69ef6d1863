"""Least squares over all frames of a segment, and how well it determines the last of them."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.codegen.kernels import residual_kernel, window_kernels
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.window.cameras import BackProjection, camera_table
from maplab_py.estimation.window.factors import FrameFactors
from maplab_py.estimation.window.inertial import InertialChain
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.prior import WindowPrior
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.standstill import Standstill
from maplab_py.estimation.window.states import WindowStates
from maplab_py.estimation.window.tracks import Observations, Tracks
from maplab_py.estimation.window.triangulation import Triangulator
from maplab_py.frontend.initialization.segment import Segment
from maplab_py.geometry import so3
from maplab_py.progress import SILENT
from maplab_py.sensors import Camera, Imu

_GAUGE_SIGMA = 1e-4
"""Standard deviation of first position [m] and heading [rad], which are free to choose."""
_WIDE_GATE_CHI2 = 30.0**2
"""Gate of the first round, in which positions are only as good as the closed form's."""
_ITERATIONS = (15, 40)
_TOLERANCE = 1e-5
_MIN_SHARE_IN_FRONT = 0.9


@dataclasses.dataclass(frozen=True)
class BiasSigmas:
    """Standard deviations of the biases' components before anything is measured."""

    gyro_radps: float
    accel_mps2: float


@dataclasses.dataclass(frozen=True, eq=False)
class Refined:
    """States of F frames, and the uncertainty of the last and of the scale."""

    states: WindowStates
    covariance: F64  # (15, 15) of the last frame, order [p, theta, v, b_g, b_a]
    travelled_m: float  # largest distance from the first position
    travelled_sigma_m: float
    median_error_px: float
    num_landmarks: int
    num_rejected: int  # tracks with parallax that fit no point

    @property
    def tilt_sigma_rad(self) -> float:
        """Largest standard deviation of the direction of gravity."""
        R = so3.to_matrix(self.states.T_M_I[-1, :4])
        in_M = R @ self.covariance[3:6, 3:6] @ R.T
        return float(np.sqrt(max(float(np.linalg.eigvalsh(in_M[:2, :2])[-1]), 0.0)))


class Refinement:
    """Solves segments of a rig with an IMU; made once, since kernels are prepared."""

    def __init__(
        self, cameras: tuple[Camera, ...], T_I_C: F64, imu: Imu, biases: BiasSigmas
    ) -> None:
        """Prepare kernels for the cameras, with poses T_I_C (C, 7), and the IMU."""
        models, self._cameras = camera_table(cameras, T_I_C)
        self._kernels = window_kernels(models)
        self._back_projection = BackProjection(self._kernels, cameras, self._cameras)
        self._inertial = residual_kernel("inertial", sources.inertial)
        options = WindowOptions()
        self._standstill = Standstill(
            residual_kernel("relative_pose", sources.relative_pose), options.standstill
        )
        self._options = options
        self._imu, self._biases = imu, biases

    def refine(self, segment: Segment, states: WindowStates) -> Refined | None:
        """Refine the states (F) of a segment; None when they are not determined."""
        with single_thread():
            return self._refined(segment, states)

    def _refined(self, segment: Segment, states: WindowStates) -> Refined | None:
        prior, seen = self._prior(states), self._observations(segment)
        for gate_chi2, loss, iterations in (
            (_WIDE_GATE_CHI2, Loss.CAUCHY, _ITERATIONS[0]),
            (self._options.gate_chi2, Loss.HUBER, _ITERATIONS[1]),
        ):
            tracks, candidates = self._tracks(segment, seen, states, gate_chi2)
            rows = tracks.landmark_rows
            if not len(rows):
                return None
            problem, order = self._problem(segment, tracks, states, prior, loss)
            start = WindowStates(states.T_M_I, states.motion, tracks.h[rows])
            solver = SolverOptions(num_iterations=iterations, function_tolerance=_TOLERANCE)
            states, summary = optimize_states(problem, start, solver, SILENT)
        error_px, depth = problem.errors(states)
        has_converged = summary.iterations < _ITERATIONS[1] and np.isfinite(states.motion).all()
        if not len(order) or not has_converged or np.mean(depth > 0.0) < _MIN_SHARE_IN_FRONT:
            return None
        far = int(np.argmax(np.linalg.norm(states.T_M_I[:, 4:] - states.T_M_I[0, 4:], axis=1)))
        try:
            linear = problem.undamped_near(states)
            covariance = problem.covariance(linear, len(segment) - 1)
            covariance_far = problem.covariance(linear, far)[:3, :3]
        except NotPositiveDefinite:
            return None
        way = states.T_M_I[far, 4:] - states.T_M_I[0, 4:]
        length = float(np.linalg.norm(way))
        ahead = way / max(length, 1e-9)
        return Refined(
            states=states,
            covariance=covariance,
            travelled_m=length,
            travelled_sigma_m=float(np.sqrt(max(float(ahead @ covariance_far @ ahead), 0.0))),
            median_error_px=float(np.median(error_px)),
            num_landmarks=len(rows),
            num_rejected=candidates - len(rows),
        )

    def _prior(self, states: WindowStates) -> WindowPrior:
        """Return the prior of the first frame: position and heading fixed, biases weakly held."""
        root = np.zeros((10, 15 * len(states)))
        root[:3, :3] = np.eye(3) / _GAUGE_SIGMA
        # a small turn dtheta on the right is R dtheta in M
        root[3, 3:6] = so3.to_matrix(states.T_M_I[0, :4])[2] / _GAUGE_SIGMA
        root[4:7, 9:12] = np.eye(3) / self._biases.gyro_radps
        root[7:10, 12:15] = np.eye(3) / self._biases.accel_mps2
        motion = states.motion.copy()
        motion[:, 3:] = 0.0
        is_fixed = np.zeros(len(states), dtype=np.bool_)
        return WindowPrior(root, np.zeros(10), states.T_M_I, motion, is_fixed)

    def _observations(self, segment: Segment) -> tuple[I64, Observations]:
        """Return the rows of a segment's observations that have rays, and these observations."""
        rays, valid = self._back_projection.rays(segment.camera, segment.uv_px)
        rows = np.flatnonzero(valid)
        seen = Observations(
            np.zeros(len(rows), dtype=np.int64), segment.frame[rows], segment.camera[rows],
            segment.uv_px[rows], segment.sigma_px[rows], rays[rows],
        )  # fmt: skip
        return rows, seen

    def _tracks(
        self,
        segment: Segment,
        observed: tuple[I64, Observations],
        states: WindowStates,
        gate_chi2: float,
    ) -> tuple[Tracks, int]:
        """Return tracks with landmarks triangulated, and how many could have become one."""
        rows, seen = observed
        tracks = Tracks()
        tracks.add_frames(range(len(segment)), seen.frame, segment.track_id[rows], seen)
        counts = tracks.counts()
        candidates = np.flatnonzero(counts >= 2)
        candidates = candidates[np.argsort(-counts[candidates], kind="stable")]
        options = dataclasses.replace(self._options, gate_chi2=gate_chi2)
        Triangulator(self._kernels, self._cameras, options).add_landmarks(
            tracks, candidates, states.T_M_I, only_stereo=False
        )
        return tracks, min(len(candidates), options.max_landmarks)

    def _problem(
        self,
        segment: Segment,
        tracks: Tracks,
        states: WindowStates,
        prior: WindowPrior,
        loss: Loss,
    ) -> tuple[WindowProblem, I64]:
        chain = InertialChain(self._inertial, self._imu)
        samples = [segment.samples(edge) for edge in range(len(segment) - 1)]
        chain.extend(samples, states.motion[:-1])
        none = np.zeros(len(segment), dtype=np.bool_)
        factors = FrameFactors(chain, self._standstill, none, none)
        data, order = tracks.data(tracks.landmark_rows, self._options.huber_sigmas)
        return WindowProblem(self._kernels, data, self._cameras, factors, prior, loss=loss), order


def mission_frame(g_A: F64) -> F64:
    """Return q_M_A (4,) of a frame M with gravity along -z, turned as little as possible from A."""
    up = -g_A / np.linalg.norm(g_A)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return so3.identity() if cosine > 0.0 else np.array([1.0, 0.0, 0.0, 0.0])
    return so3.exp(axis / sine * np.arctan2(sine, cosine))
