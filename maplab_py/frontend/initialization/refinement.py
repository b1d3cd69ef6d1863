"""Least squares over all frames of a segment, and how well it determines the last of them."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.codegen.kernels import residual_kernel, window_kernels
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE, WindowPoint
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.solver import SolverOptions, optimizing_states
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.window import calibration, inertial, triangulation
from maplab_py.estimation.window.cameras import BackProjection, CameraPoses
from maplab_py.estimation.window.factors import FrameFactors, Standstill
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.prior import WindowPrior
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.states import WindowStates, scale_sigma
from maplab_py.estimation.window.tracks import Observations, Tracks
from maplab_py.frontend.initialization import imu_noise, normal_points, paced_work
from maplab_py.frontend.initialization.segment import Segment
from maplab_py.geometry import so3
from maplab_py.progress import SILENT
from maplab_py.sensors import Camera, Imu

_GAUGE_SIGMA = 1e-4
"""Standard deviation of first position [m] and heading [rad], which are free to choose."""
_GATE_CHI2 = 13.8
"""Gate of observations (99.9 %). A track over 28 frames whose points all pass 99 % would be rare."""
_WIDE_GATE_CHI2 = 30.0**2
"""Gate of the first round, in which positions are only as good as the closed form's."""
_ITERATIONS = (15, 40)
_MAX_LANDMARKS = 200
_TOLERANCE = 1e-5
_MIN_SHARE_IN_FRONT = 0.9
_NEAR_SCALE_FACTOR = 2.0
"""The scale is not known more than so much better with less noise of the IMU."""
_LEAST_INVERSE_DEPTH = 1e-4
"""Of landmarks [1/m] for which observations are averaged."""
_UNITS_PER_FRAME, _TRIANGULATION_UNITS, _COVARIANCE_UNITS = 0.17, 4.0, 5.0
_NORMAL_POINTS_UNITS = 5.0
"""Units of work of an iteration for each frame, and of other parts."""


@dataclasses.dataclass(frozen=True, eq=False)
class Refined:
    """States of F frames, and the uncertainty of the last and of the scale."""

    time_ns: I64  # (F,)
    states: WindowStates
    covariance: F64  # (15, 15) of the last frame, order [p, theta, v, b_g, b_a]
    travelled_sigma_m: float  # of the largest distance from the first position
    scale_sigma: float  # standard deviation of the scale of all positions, as a share of it
    median_error_px: float
    num_landmarks: int
    imu: Imu  # with the noise that was assumed or estimated

    @property
    def tilt_sigma_rad(self) -> float:
        """Largest standard deviation of the direction of gravity."""
        R = so3.to_matrix(self.states.T_M_I[-1, :4])
        in_M = R @ self.covariance[3:6, 3:6] @ R.T
        return float(np.sqrt(max(float(np.linalg.eigvalsh(in_M[:2, :2])[-1]), 0.0)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Round:
    """Settings of one solution of a segment."""

    segment: Segment
    observed: tuple[I64, Observations]  # rows of the segment's observations that have rays
    imu: Imu
    gate_chi2: float
    loss: Loss
    iterations: int


@dataclasses.dataclass(frozen=True, eq=False)
class _Solved:
    """Result of a round."""

    problem: WindowProblem
    chain: inertial.InertialChain
    states: WindowStates
    imu: Imu
    tracks: Tracks  # whose landmarks are those of the states
    has_converged: bool


class Refinement:
    """Solves segments of a rig with an IMU; made once, since kernels are prepared."""

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        T_I_C: F64,
        imu: Imu,
        bias_sigmas: tuple[float, float],
        data_sheet: Imu,
    ) -> None:
        """Prepare kernels for the cameras, with poses T_I_C (C, 7), and the IMU.

        Args:
            T_I_C: Their poses.
            imu: With the noise that is assumed.
            bias_sigmas: Deviations of a component of the gyroscope's and the accelerometer's bias.
            data_sheet: The IMU with the least noise that it can have.
        """
        self._calibration = calibration.WindowCalibration.of(cameras, T_I_C)
        self._kernels = window_kernels()
        self._back_projection = BackProjection(self._kernels, self._calibration)
        self._inertial = residual_kernel("inertial", sources.inertial)
        options = WindowOptions(max_landmarks=_MAX_LANDMARKS, gate_chi2=_GATE_CHI2)
        still = residual_kernel("relative_pose", sources.relative_pose)
        self._standstill, self._options = Standstill(still, options), options
        self._imu, self._bias_sigmas, self._data_sheet = imu, bias_sigmas, data_sheet

    def refine(
        self, segment: Segment, states: WindowStates, *, wanted_scale_sigma: float = 0.0
    ) -> paced_work.Work[Refined | None]:
        """Refine the states (F) of a segment; the result is None when they are not determined.

        Args:
            segment: Frames.
            states: Their approximate states.
            wanted_scale_sigma: Where the deviation of the scale comes near to this, use the frames between
                those of the segment and estimate the noise of the IMU, too; 0 = never.
        """
        round_ = _Round(
            segment, self._observations(segment), self._imu, _WIDE_GATE_CHI2, Loss.CAUCHY,
            _ITERATIONS[0],
        )  # fmt: skip
        solved = yield from self._solved(round_, states)
        if solved is None:
            return None
        round_ = dataclasses.replace(
            round_, gate_chi2=self._options.gate_chi2, loss=Loss.HUBER, iterations=_ITERATIONS[1]
        )
        solved = yield from self._solved(round_, solved.states)
        refined = self._judged(segment, solved)
        if refined is None or refined.scale_sigma > _NEAR_SCALE_FACTOR * wanted_scale_sigma:
            return refined
        assert solved is not None
        segment = normal_points.with_normal_points(
            segment, solved.states, *self._landmarks(solved), self._calibration,
            self._options.gate_chi2,
        )  # fmt: skip
        yield _NORMAL_POINTS_UNITS
        imu, observed = self._with_estimated_noise(solved), self._observations(segment)
        yield _COVARIANCE_UNITS
        round_ = dataclasses.replace(round_, segment=segment, observed=observed, imu=imu)
        again = yield from self._solved(round_, solved.states)
        return self._judged(segment, again)

    def _landmarks(self, solved: _Solved) -> tuple[I64, F64]:
        """Return ids (L,) and places (L, 3) of the landmarks of a round that are not at infinity."""
        tracks = solved.tracks
        rows = tracks.landmark_rows[tracks.h[tracks.landmark_rows, 2] > _LEAST_INVERSE_DEPTH]
        poses = CameraPoses.of(solved.states.T_M_I, self._calibration.T_I_C)
        return tracks.id[rows], tracks.points(rows, poses)

    def _with_estimated_noise(self, solved: _Solved) -> Imu:
        """Return the IMU with the noise that the residuals show; as assumed when they cannot tell."""
        try:
            covariance = solved.problem.covariance_of_all(solved.states)
        except NotPositiveDefinite:
            return self._imu
        factor = imu_noise.noise_factor(solved.chain, solved.states, covariance)
        return imu_noise.with_least_noise(
            self._data_sheet,
            factor * self._imu.gyro_noise_density,
            factor * self._imu.acc_noise_density,
        )

    def _solved(self, round_: _Round, states: WindowStates) -> paced_work.Work[_Solved | None]:
        """Triangulate landmarks from states and solve; the result is None without landmarks."""
        segment = round_.segment
        tracks = self._tracks(segment, round_.observed, states, round_.gate_chi2)
        rows = tracks.landmark_rows
        if not len(rows):
            return None
        chain = inertial.InertialChain(self._inertial, round_.imu)
        samples = [segment.samples(edge) for edge in range(len(segment) - 1)]
        chain.extend(samples, states.motion[:-1])
        none = np.zeros(len(segment), dtype=np.bool_)
        factors = FrameFactors(chain, self._standstill, none, none)
        data, order = tracks.data(rows, self._options.huber_sigmas)
        prior = self._prior(states)
        problem = WindowProblem(
            self._kernels, data, self._calibration, factors, prior, loss=round_.loss
        )
        start = WindowStates(states.T_M_I, states.motion, tracks.h[rows])
        solver = SolverOptions(num_iterations=round_.iterations, function_tolerance=_TOLERANCE)
        yield _TRIANGULATION_UNITS
        steps = optimizing_states(problem, start, solver, SILENT)
        states, summary = yield from paced_work.each_step(steps, _UNITS_PER_FRAME * len(segment))
        has_converged = summary.iterations < round_.iterations and len(order) > 0
        tracks.h[rows] = states.h
        return _Solved(problem, chain, states, round_.imu, tracks, has_converged)

    @staticmethod
    def _judged(segment: Segment, solved: _Solved | None) -> Refined | None:
        """Compute covariances; None when the states are not determined."""
        if solved is None:
            return None
        states, problem = solved.states, solved.problem
        if not solved.has_converged or not np.isfinite(states.motion).all():
            return None
        error_px, depth = problem.errors(states)
        if np.mean(depth > 0.0) < _MIN_SHARE_IN_FRONT:
            return None
        far = int(np.argmax(np.linalg.norm(states.T_M_I[:, 4:] - states.T_M_I[0, 4:], axis=1)))
        try:
            of_frames = problem.covariance_of_all(states)
        except NotPositiveDefinite:
            return None
        last, first_far = FRAME_SIZE * (len(states) - 1), FRAME_SIZE * far
        covariance = of_frames[last:, last:]
        covariance_far = of_frames[first_far : first_far + 3, first_far : first_far + 3]
        way = states.T_M_I[far, 4:] - states.T_M_I[0, 4:]
        ahead = way / max(float(np.linalg.norm(way)), 1e-9)
        return Refined(
            time_ns=segment.time_ns,
            states=states,
            covariance=covariance,
            travelled_sigma_m=float(np.sqrt(max(float(ahead @ covariance_far @ ahead), 0.0))),
            scale_sigma=scale_sigma(states.T_M_I[:, 4:], of_frames),
            median_error_px=float(np.median(error_px)),
            num_landmarks=len(solved.states.h),
            imu=solved.imu,
        )

    def _prior(self, states: WindowStates) -> WindowPrior:
        """Return the prior of the first frame: position and heading fixed, biases weakly held."""
        root = np.zeros((10, 15 * len(states)))
        root[:3, :3] = np.eye(3) / _GAUGE_SIGMA
        # a small turn dtheta on the right is R dtheta in M
        root[3, 3:6] = so3.to_matrix(states.T_M_I[0, :4])[2] / _GAUGE_SIGMA
        root[4:7, 9:12] = np.eye(3) / self._bias_sigmas[0]
        root[7:10, 12:15] = np.eye(3) / self._bias_sigmas[1]
        motion = states.motion.copy()
        motion[:, 3:] = 0.0
        x0 = dataclasses.replace(states, motion=motion)
        return WindowPrior(root, np.zeros(10), x0, np.zeros(len(states), dtype=np.bool_))

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
    ) -> Tracks:
        """Return tracks with landmarks triangulated."""
        rows, seen = observed
        tracks = Tracks()
        tracks.add(range(len(segment)), segment.track_id[rows], seen)
        counts = tracks.counts()
        candidates = np.flatnonzero(counts >= 2)
        candidates = candidates[np.argsort(-counts[candidates], kind="stable")]
        options = dataclasses.replace(self._options, gate_chi2=gate_chi2)
        cameras = self._calibration.of_kernels(states.calibration)
        at = WindowPoint(states.T_M_I, tracks.h, cameras, np.zeros((0, 7)))
        triangulation.Triangulator(self._kernels, options).add_landmarks(
            tracks, candidates, at, only_stereo=False
        )
        return tracks


def mission_frame(g_A: F64) -> F64:
    """Return q_M_A (4,) of a frame M with gravity along -z, turned as little as possible from A."""
    up = -g_A / np.linalg.norm(g_A)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = float(np.linalg.norm(axis)), float(up[2])
    if sine < 1e-12:
        return so3.identity() if cosine > 0.0 else np.array([1.0, 0.0, 0.0, 0.0])
    return so3.exp(axis / sine * np.arctan2(sine, cosine))
