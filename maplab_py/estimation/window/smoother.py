"""The fixed-lag smoother of tracked frames and inertial samples.

Source of the frame policy: Leutenegger et al., Keyframe-based Visual-Inertial Odometry Using Nonlinear
Optimization, IJRR 2015, section 4.2; of the marginal prior: Usenko et al., Visual-Inertial Mapping with
Non-Linear Factor Recovery, RA-L 2020, section IV.
"""

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask, mask_of
from maplab_py.errors import EstimationError
from maplab_py.estimation.codegen.kernels import residual_kernel, window_kernels
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE, WindowPoint
from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.window import inertial, keyframes, marginalization, triangulation, turning
from maplab_py.estimation.window.calibration import FrameTimes, WindowCalibration
from maplab_py.estimation.window.cameras import BackProjection, CameraPoses
from maplab_py.estimation.window.factors import FrameFactors, Standstill
from maplab_py.estimation.window.frame import (
    FrameRows,
    ImuPart,
    Motion,
    StartState,
    WindowFrame,
    WindowUpdate,
)
from maplab_py.estimation.window.map_terms import MapTerms
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.prior import WindowPrior
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.recalibration import WindowChange
from maplab_py.estimation.window.states import WindowStates
from maplab_py.estimation.window.tracks import Observations, Tracks
from maplab_py.progress import SILENT
from maplab_py.sensors import Camera, Imu
from maplab_py.vimap.nav_state import NavState

_MIN_KNOWN_DEPTHS = 10
"""Landmarks of which the median depth is taken."""
_ENOUGH_LANDMARKS = 150
"""Landmarks of the window beside which none is expected: noise of tracks at rest looks like a turn."""


class FixedLagSmoother:
    """Estimates the frames of a window from tracks and inertial samples.

    A window has a number of keyframes and the latest frames. The latest become keyframes or are
    dropped, their inertial intervals joined and their observations forgotten. The oldest keyframe is
    marginalised together with the landmarks anchored in it whose tracks have ended. Landmarks still
    tracked lose its observation and are anchored where they were seen next (see decision 20).
    """

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        T_I_C: F64,
        imu: Imu,
        options: WindowOptions,
        calibration: WindowCalibration | None = None,
    ) -> None:
        """Prepare kernels for cameras at T_I_C (C, 7) and an IMU.

        Args:
            cameras, T_I_C, imu, options: See above.
            calibration: Of the same cameras, with what of it is estimated; None = nothing.
        """
        self.calibration = calibration or WindowCalibration.of(cameras, T_I_C)
        self.cameras = self.calibration.of_kernels(self.calibration.mean)
        self.options = options
        self._keyframes_kept = options.keyframes_kept(len(cameras))
        self._solver = SolverOptions(
            num_iterations=options.num_iterations, function_tolerance=options.function_tolerance
        )
        self._kernels = window_kernels()
        self._back_projection = BackProjection(self._kernels, self.calibration)
        self._chain = inertial.InertialChain(residual_kernel("inertial", sources.inertial), imu)
        still = residual_kernel("relative_pose", sources.relative_pose)
        self._standstill = Standstill(still, options)
        self._triangulator = triangulation.Triangulator(self._kernels, options)
        self.tracks = Tracks()
        self._inverse_depth = 0.0  # median of landmarks [1/m], 0 = not known yet
        self.newest_covariance: F64 = np.full((15, 15), np.inf)  # order [p, theta, v, b_g, b_a]
        self._frames = FrameRows()
        self._states = WindowStates(np.zeros((0, 7)), np.zeros((0, 9)), np.zeros((0, 3)))
        self._stage_ms: dict[str, float] = {}
        self._released: list[NavState] = []

    def start(self, frame: WindowFrame, state: StartState) -> None:
        """Begin with a first frame, whose IMU samples are not read, at a state.

        Raises:
            EstimationError: The smoother has been started before.
        """
        if len(self._states):
            raise EstimationError("the smoother has been started already: make a new one")
        motion, T_M_I = state.motion, np.array(state.T_M_I, dtype=np.float64)
        mean = self.calibration.mean
        self._prior = WindowPrior.of_state(
            T_M_I[0], motion[0], np.asarray(state.sigma), (mean, self.calibration.sigma)
        )
        self._states = WindowStates(T_M_I, motion, np.zeros((0, 3)), calibration=mean)
        self._take_calibration()
        self._append_frame(frame, is_keyframe=True)
        self._see(frame)

    def add(self, frame: WindowFrame) -> WindowUpdate:
        """Add a frame, estimate all states again, and make room for the next frame.

        Raises:
            EstimationError: The smoother has not been started, or the cost is not finite.
            MapError: Times of IMU samples run backwards, or a sample is not a number.
        """
        if not len(self._states):
            raise EstimationError("the smoother has not been started: call start() first")
        self._stage_ms, self._released = {}, []
        with single_thread():
            with self._stage("predict"):
                frame = self._predict(frame)
            with self._stage("landmarks"):
                self._see(frame)
                self._gate_new()
                self._triangulate(frame.motion)
            with self._stage("optimise"):
                map_terms = self._map_terms()  # it takes tracks from the odometry's landmarks
                problem, rows, order = self._problem(self.tracks.landmark_rows, map_terms)
                self._states, _ = optimize_states(problem, self._states, self._solver, SILENT)
                self.tracks.h[rows] = self._states.h
                self._take_calibration()
                self._take_map_states()
            with self._stage("covariance"):
                self.newest_covariance = self._covariance(problem)
            with self._stage("outliers"):
                error_px = self._remove_outliers(problem, order)
            with self._stage("slide"):
                newest = self._nav_state(len(self._states) - 1)
                self._frames.is_keyframe[-1] = is_keyframe = self._decide(frame.motion)
                self._slide()
        return WindowUpdate(
            state=newest,
            covariance=self.newest_covariance,
            is_keyframe=is_keyframe,
            num_landmarks=len(rows),
            median_error_px=error_px,
            released=NavState.stack(self._released),
            stage_ms=self._stage_ms,
        )

    def doubt_imu(self, since_ns: int, parts: ImuPart) -> None:
        """Give next to no weight to the samples of failed parts of the IMU since a time."""
        self._chain.doubt(since_ns, parts)

    def recalibrate(self, cameras: tuple[Camera, ...], T_I_C: F64, imu: Imu) -> None:
        """Express the window with another calibration, of which nothing is estimated; see `WindowChange`."""
        before = self.cameras, self._chain.corrections
        calibration, seen = WindowCalibration.of(cameras, T_I_C), self.tracks.observations
        self._back_projection = BackProjection(self._kernels, calibration)
        self._remove(np.flatnonzero(~self._back_projection.rays(seen.camera, seen.uv_px)[1]))
        self.calibration, self.cameras = calibration, calibration.of_kernels(calibration.mean)
        self._chain.take_imu(imu)
        change = WindowChange.between(before, (self.cameras, self._chain.corrections))
        window = self._states, self._frames.rate_I, self._chain.mean_samples()
        self._prior, self._states = change.prior(self._prior, *window), change.states(*window)
        self._chain.integrate_again(self._states.motion)
        seen, frame = self.tracks.observations, self.tracks.observations.frame.astype(np.int64)
        self.tracks.replace_rays(self._rays(seen.camera, seen.uv_px, frame)[0])

    def landmarks(self) -> tuple[I64, F64]:
        """Return track ids (L,) and places p_M (L, 3) of the landmarks in the window that are not too far."""
        rows = self.tracks.landmark_rows
        rows = rows[self.tracks.h[rows, 2] * self.options.max_depth_m >= 1.0]
        return self.tracks.id[rows], self.tracks.points(rows, self._poses())

    @property
    def states(self) -> WindowStates:
        """States of the frames in the window; of landmarks as of the last update."""
        return self._states

    @property
    def prior(self) -> WindowPrior:
        """Marginalization prior on the frames in the window."""
        return self._prior

    @property
    def times_ns(self) -> I64:
        """Times (F,) of the frames in the window."""
        return self._frames.time_ns

    @property
    def is_keyframe(self) -> Mask:
        """Frames (F,) that are, or will become, keyframes."""
        return self._frames.is_keyframe

    @property
    def median_depth_m(self) -> float:
        """Median depth of the landmarks; infinite while it is not known."""
        return 1.0 / self._inverse_depth if self._inverse_depth > 0.0 else np.inf

    def scale_sigma(self) -> float:
        """Return the standard deviation of the scale of the window, as a share; infinite = unknown."""
        return self.problem()[0].scale_sigma(self._states)

    def calibration_sigma(self) -> F64:
        """Return the standard deviations (K,) of the calibration; infinite = unknown."""
        if not len(self.calibration) or not len(self._states):
            return self.calibration.sigma
        return self.problem()[0].calibration_sigma(self._states)

    def problem(self) -> tuple[WindowProblem, WindowStates]:
        """Return the current least-squares problem of the window, and its states."""
        return self._problem(self.tracks.landmark_rows, self._map_terms())[0], self._states

    # -- a new frame ------------------------------------------------------------------------------

    def _predict(self, frame: WindowFrame) -> WindowFrame:
        """Append the frame where the IMU says it is; at rest it replaces the latest one.

        Return it, moving if it seemed to turn only and shows parallax over a longer time.
        """
        is_resting = frame.motion is Motion.RESTING
        times_ns, accel_gyro = frame.imu_times_ns, frame.accel_gyro
        if is_resting and self._may_replace(frame):
            before_ns, before = self._chain.last_samples()
            times_ns = np.concatenate([before_ns, times_ns[1:]])
            accel_gyro = np.concatenate([before, accel_gyro[1:]])
            self._drop_last()
        motion = self._states.motion[-1]
        self._chain.append(times_ns, accel_gyro, motion, is_resting=is_resting, failed=frame.failed)
        if is_resting:
            self._frames.is_resting[-1] = True
        T_M_I, new_motion = self._chain.predict(self._states.T_M_I[-1], motion)
        self._states = self._states.with_frame(T_M_I, new_motion)
        self._prior = self._prior.with_frame(T_M_I, new_motion)
        if frame.motion is Motion.TURNING and turning.shows_parallax(
            frame, self._frames.time_ns, self.tracks, self._states.T_M_I, self.cameras.T_I_C,
            self._back_projection,
        ):  # fmt: skip
            frame = dataclasses.replace(frame, motion=Motion.MOVING)
        self._append_frame(frame, is_keyframe=False)
        return frame

    def _may_replace(self, frame: WindowFrame) -> bool:
        """Return whether the latest frame rests, too, and the joined interval is not too long."""
        if len(self._states) < 2 or not self._chain.is_resting[-1] or self._frames.is_keyframe[-1]:
            return False
        return (frame.time_ns - int(self._frames.time_ns[-2])) * 1e-9 <= self.options.max_joined_s

    def _append_frame(self, frame: WindowFrame, *, is_keyframe: bool) -> None:
        turns, is_sure = turning.is_on_the_spot(
            frame, self._states.motion[-1], self.newest_covariance, self.options
        )
        rests = frame.motion is Motion.RESTING or is_sure
        self._frames.append(frame, is_keyframe=is_keyframe, is_resting=rests, is_turning=turns)

    def _see(self, frame: WindowFrame) -> None:
        """Add the observations of the newest frame."""
        number = len(self._states) - 1
        newest = np.full(len(frame.camera), number, dtype=np.int64)
        rays, valid = self._rays(frame.camera, frame.uv_px, newest)
        seen = Observations(
            newest, newest.astype(np.int32), frame.camera.astype(np.int32),
            np.asarray(frame.uv_px, dtype=np.float64),
            np.asarray(frame.sigma_px, dtype=np.float64), rays,
        )  # fmt: skip
        track_id = frame.track_id[valid].astype(np.int64)
        self.tracks.add(range(number, number + 1), track_id, seen.take(valid))

    def _rays(self, camera: I32, uv_px: F64, frame: I64) -> tuple[F64, Mask]:
        """Return unit rays (N, 3) of pixels at the times of their frames (N,), and whether they exist."""
        rays, valid = self._back_projection.rays(camera, uv_px)
        if self.calibration.has_lateness:
            rate_I = self._frames.rate_I[frame] - self._states.gyro_bias[frame]
            rays = self.calibration.rays_at_frame(
                camera, uv_px, self._frames.delay_s[frame], rays, self.cameras, rate_I
            )
        return rays, valid

    def _gate_new(self) -> None:
        """Remove observations of the newest frame far from where landmarks are expected.

        When most are, the expectation is wrong and all stay.
        """
        tracks, newest = self.tracks, len(self._states) - 1
        seen = np.flatnonzero(tracks.is_landmark & tracks.is_active)
        problem, _, order = self._problem(seen)
        error, depth = problem.errors(self._states)
        sigma2 = tracks.observations.sigma_px[order] ** 2 + self.options.prediction_sigma_px**2
        is_new = tracks.observations.frame[order] == newest
        far = is_new & ((error**2 > self.options.gate_chi2 * sigma2) | (depth <= 0.0))
        if 2 * np.count_nonzero(far) < np.count_nonzero(is_new):
            self._remove(order[far])

    def _triangulate(self, motion: Motion) -> None:
        tracks, options = self.tracks, self.options
        num_best = length = None
        if options.follows_thesis:
            num_best, length = options.thesis_landmarks_per_update, options.thesis_track_length
        candidates = tracks.candidates(self._may_be_landmark(), length)
        narrow = self._triangulator.add_landmarks(
            tracks, candidates, self._point(),
            only_stereo=motion is not Motion.MOVING, num_best=num_best,
        )  # fmt: skip
        if not options.follows_thesis:
            self._expect_depths(narrow, motion)

    def _expect_depths(self, rows: I64, motion: Motion) -> None:
        """While only turning, make landmarks of tracks (rows) without parallax.

        At about the median depth of the landmarks before the turn, they show that there is no translation.
        """
        tracks, options = self.tracks, self.options
        known = tracks.landmark_rows
        if len(known) >= _MIN_KNOWN_DEPTHS:
            self._inverse_depth = float(np.median(tracks.h[known, 2]))
        if motion is Motion.TURNING and self._inverse_depth > 0.0:
            room = max(_ENOUGH_LANDMARKS - len(known), 0)
            tracks.expect(rows[:room], self._inverse_depth, options.expected_depth_share)

    # -- estimation -------------------------------------------------------------------------------

    def _problem(
        self, rows: I64, map_terms: MapTerms | None = None
    ) -> tuple[WindowProblem, I64, I64]:
        """Return the problem with some landmarks, their rows, and its observations' rows."""
        data, order = self.tracks.data(rows, self.options.huber_sigmas)
        factors = FrameFactors(
            self._chain, self._standstill, self._frames.is_resting, self._frames.is_turning
        )
        problem = WindowProblem(
            self._kernels, data, self.calibration, factors, self._prior,
            map_terms=map_terms, times=self._times(),
        )  # fmt: skip
        self._states = dataclasses.replace(self._states, h=self.tracks.h[rows])
        return problem, rows, order

    def _times(self) -> FrameTimes | None:
        frames = self._frames
        return FrameTimes(frames.rate_I, frames.delay_s) if self.calibration.has_lateness else None

    def _point(self) -> WindowPoint:
        """Return frames and cameras as kernels read them."""
        times = self._times()
        twist = np.zeros((0, 7)) if times is None else times.twist(self._states)
        return WindowPoint(self._states.T_M_I, self._states.h, self.cameras, twist)

    def _take_calibration(self) -> None:
        """Use the present calibration from now on."""
        if len(self.calibration):
            self.cameras = self.calibration.of_kernels(self._states.calibration)
            self._back_projection.parameters = self.cameras.parameters

    def _covariance(self, problem: WindowProblem) -> F64:
        newest = FRAME_SIZE * (len(self._states) - 1) + np.arange(FRAME_SIZE)
        return problem.covariance(self._states, newest)

    def _remove_outliers(self, problem: WindowProblem, order: I64) -> float:
        """Remove observations with errors beyond the gate; return the median error [px]."""
        if not len(order):
            return float("nan")
        error, depth = problem.errors(self._states)
        sigma, median = self.tracks.observations.sigma_px[order], float(np.median(error))
        bad = (error > self.options.largest_error_px(sigma, median)) | (depth <= 0.0)
        self._remove(order[bad])
        return median

    def _remove(self, observations: I64) -> None:
        if len(observations):
            is_removed = mask_of(len(self.tracks.observations), observations)
            self.tracks.remove_observations(is_removed, self._poses())

    # -- what a localised smoother adds -----------------------------------------------------------

    def _may_be_landmark(self) -> Mask | bool:
        """Return which tracks (T,) may become landmarks of the odometry."""
        return True

    def _map_terms(self) -> MapTerms | None:
        """Return the observations of a map."""
        return None

    def _leaving_map_terms(self) -> MapTerms | None:
        """Return the observations of a map that leave with the first frame."""
        return None

    def _take_map_states(self) -> None:
        """Keep the estimated landmarks of the map."""

    def _forget_leaving_map_tracks(self) -> None:
        """Remove the tracks that have left with the first frame."""

    # -- frames leave -----------------------------------------------------------------------------

    def _decide(self, motion: Motion) -> bool:
        """Return whether the newest frame becomes a keyframe."""
        if motion is Motion.RESTING:
            return False
        last = int(np.flatnonzero(self._frames.is_keyframe)[-1])
        return keyframes.needs_keyframe(
            self.tracks, self._states.T_M_I, self.cameras.T_I_C, last, self.options
        )

    def _slide(self) -> None:
        """Keep at most the wanted number of keyframes and of frames after them."""
        options = self.options
        if options.follows_thesis:
            self._marginalize_used()
        leaving = len(self._states) - options.num_recent_frames
        if leaving > 0 and not self._frames.is_keyframe[leaving]:
            self._drop(leaving)
        elif leaving >= self._keyframes_kept:
            self._marginalize_first()

    def _drop(self, frame: int) -> None:
        """Remove a frame that is not a keyframe, without its observations.

        The intervals that meet in it are joined, or marginalised when they would become too long.
        """
        self._release(frame)
        self.tracks.remove_frame(frame, self._poses())
        if self._chain.joined_s(frame) <= self.options.max_joined_s:
            self._chain.join(frame, self._states.motion[frame - 1])
            self._prior = self._prior.without_frame(frame)
        else:
            self._marginalize(np.zeros(0, dtype=np.int64), frame)
            self._chain.open(frame)
        self._forget_frame(frame)

    def _drop_last(self) -> None:
        """Remove the newest frame, the edge to it, and its observations."""
        frame = len(self._states) - 1
        self._release(frame)
        self.tracks.remove_frame(frame, self._poses())
        self._chain.drop_last()
        self._prior = self._prior.without_frame(frame)
        self._forget_frame(frame)

    def _marginalize_first(self) -> None:
        """Marginalise the first frame and the landmarks anchored in it whose tracks have ended."""
        tracks = self.tracks
        rows = tracks.landmark_rows
        rows = rows[(tracks.anchor_frame[rows] == 0) & ~tracks.is_active[rows]]
        self._marginalize(rows, 0, self._leaving_map_terms())
        self._forget_leaving_map_tracks()
        self._release(0)
        tracks.remove_frame(0, self._poses(), rows)
        self._chain.drop_first()
        self._forget_frame(0)

    def _marginalize_used(self) -> None:
        """Marginalise all landmarks but a few of those that are still tracked.

        Source: Schneider 2019, Paper I, sections 3.3 and 3.4.
        """
        tracks = self.tracks
        tracks.make_persistent(self.options.thesis_persistent_landmarks)
        rows = np.flatnonzero(tracks.is_landmark & ~tracks.is_persistent)
        if len(rows):
            self._marginalize(rows, None)
            tracks.remove_tracks(rows, self._poses(), close=False)

    def _marginalize(self, rows: I64, frame: int | None, map_terms: MapTerms | None = None) -> None:
        """Put all that landmarks (rows) and a frame say about other states into the prior."""
        problem, _, _ = self._problem(rows, map_terms)
        self._prior = marginalization.marginalized(problem, self._prior, self._states, frame=frame)

    def _release(self, frame: int) -> None:
        self._released.append(self._nav_state(frame))

    def _nav_state(self, frame: int) -> NavState:
        rows, states = slice(frame, frame + 1), self._states
        return NavState.of_motion(
            self._frames.time_ns[rows], states.T_M_I[rows], states.motion[rows]
        )

    def _forget_frame(self, frame: int) -> None:
        self._states = self._states.without_frame(frame)
        self._frames.remove(frame)

    def _poses(self) -> CameraPoses:
        return CameraPoses.of(self._states.T_M_I, self.cameras.T_I_C)

    # -- report -----------------------------------------------------------------------------------

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        began = time.thread_time()
        yield
        self._stage_ms[name] = 1e3 * (time.thread_time() - began)
