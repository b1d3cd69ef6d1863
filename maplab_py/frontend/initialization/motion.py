"""Start in motion: gyroscope bias, closed form, refinement, and what is still unknown afterwards."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.linear.threads import single_thread
from maplab_py.estimation.window.frame import StartState
from maplab_py.estimation.window.states import WindowStates
from maplab_py.frontend.initialization import imu_noise, linear, paced_work, refinement
from maplab_py.frontend.initialization.gyro_bias import (
    Turns,
    estimate_gyro_bias,
    integrate_turns,
    ray_pairs,
)
from maplab_py.frontend.initialization.options import InitializationOptions
from maplab_py.frontend.initialization.rays import RayMaker, SegmentRays
from maplab_py.frontend.initialization.segment import Segment
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Imu

_MIN_PAIRS = 3
_MIN_SHARE_IN_FRONT = 0.7
_POSITION_SIGMA_M = 1e-4
_BIAS_WALK_S = 3600.0
_MOST_ACCEL_BIAS_MPS2 = 0.8
_MAX_BIAS_SIGMAS = 4.0
_PROVISIONAL_TILT_RAD, _LEAST_KNOWN_SCALE = 0.1, 0.5
"""Largest standard deviations of tilt and scale from which the estimator can follow."""
_GYRO_BIAS_UNITS, _MOTION_UNITS = 22.0, 22.0
"""Units of work of the closed forms, rays included."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Largest standard deviations with which the estimator may start."""

    scale_sigma: float  # as a share of the scale
    tilt_deg: float


@dataclasses.dataclass(frozen=True, eq=False)
class Attempt:
    """A start in motion, or why there is none."""

    state: StartState | None
    reason: str  # empty when there is a state
    refined: refinement.Refined | None = None  # what the state was taken from
    provisional: StartState | None = None  # a state of which much is only expected
    scale_sigma: float = 0.0  # with that state


class MotionStart:
    """Solves segments of a rig in motion."""

    def __init__(
        self, cameras: tuple[Camera, ...], T_I_C: F64, imu: Imu, options: InitializationOptions
    ) -> None:
        """Prepare for cameras with poses T_I_C (C, 7) on the IMU."""
        self._options = options
        # vibrations and errors of scale are not in the densities of a data sheet
        self.imu = imu_noise.with_least_noise(
            imu, options.least_gyro_noise_density, options.least_accel_noise_density
        )
        self._rays = RayMaker(cameras, T_I_C)
        self._accel_bias_sigma = accel_bias_sigma(imu, options)
        biases = options.gyro_bias_sigma_radps, self._accel_bias_sigma
        self._refinement = refinement.Refinement(cameras, T_I_C, self.imu, biases, imu)

    def solve(self, segment: Segment, limits: Limits | None = None) -> Attempt:
        """Estimate the state of the last frame of a segment; see `solving`."""
        with single_thread():
            return paced_work.finished(self.solving(segment, limits))

    def solving(self, segment: Segment, limits: Limits | None = None) -> paced_work.Work[Attempt]:
        """Estimate the state of the last frame of a segment in parts.

        Args:
            segment: Frames.
            limits: Of scale and gravity; None = those of the options.
        """
        options = self._options
        limits = limits or Limits(options.max_scale_sigma, options.max_tilt_sigma_deg)
        rays = self._rays.of(segment)
        pairs = ray_pairs(rays)
        if len(pairs.first_frame) < _MIN_PAIRS:
            return Attempt(
                None,
                "too few points are seen in several images: give more light, or point the camera "
                "at things with texture",
            )
        gyro_bias = estimate_gyro_bias(segment.inertial, pairs)
        yield _GYRO_BIAS_UNITS
        turns = integrate_turns(segment.inertial, gyro_bias)
        sigma = self._accel_bias_sigma
        motion = linear.solve_motion(segment.inertial, turns, gyro_bias, rays, sigma)
        if motion is None:
            return Attempt(
                None,
                "the points show no parallax: move the camera sideways, turning it is not enough",
            )
        if motion.share_in_front < _MIN_SHARE_IN_FRONT:
            return Attempt(
                None,
                f"{100 * (1 - motion.share_in_front):.0f} % of the points would lie behind the "
                "cameras: move the camera sideways, and faster",
            )
        yield _MOTION_UNITS
        # cameras that share points know the scale without the IMU
        wanted = 0.0 if shares_points(rays) else limits.scale_sigma
        states = _states(turns, gyro_bias, motion)
        refined = yield from self._refinement.refine(segment, states, wanted_scale_sigma=wanted)
        reason = self._objection(refined, rays, limits)
        if refined is not None and not reason:
            return Attempt(_start_state(segment.time_ns[-1:], refined), "", refined)
        if refined is None or not self._is_plausible(refined):
            return Attempt(None, reason, refined)
        return Attempt(
            None, reason, refined, _start_state(segment.time_ns[-1:], refined), refined.scale_sigma
        )

    def _is_plausible(self, refined: refinement.Refined) -> bool:
        """Tell whether the estimator may go on from a state, however uncertain its scale."""
        return (
            refined.num_landmarks >= self._options.min_landmarks
            and not self._contradiction(refined)
            and refined.tilt_sigma_rad <= _PROVISIONAL_TILT_RAD
            and refined.scale_sigma <= _LEAST_KNOWN_SCALE
        )

    def _objection(
        self, refined: refinement.Refined | None, rays: SegmentRays, limits: Limits
    ) -> str:
        """Return what is still unknown, empty when the estimator may start."""
        options = self._options
        if refined is None:
            return (
                "the motion is not determined yet: move the camera sideways, with changes "
                "of speed and direction"
            )
        if refined.num_landmarks < options.min_landmarks:
            return (
                f"{refined.num_landmarks} points have parallax, {options.min_landmarks} are needed: "
                "move the camera sideways, or point it at things that are nearer"
            )
        if contradiction := self._contradiction(refined):
            return contradiction
        tilt_deg = float(np.degrees(refined.tilt_sigma_rad))
        if tilt_deg > limits.tilt_deg:
            return (
                f"the direction of gravity is known to {tilt_deg:.1f} deg, "
                f"{limits.tilt_deg:.1f} are needed: change speed and direction, and turn"
            )
        scale_sigma = refined.scale_sigma
        is_known = shares_points(rays) and refined.travelled_sigma_m <= options.max_rig_sigma_m
        if scale_sigma > limits.scale_sigma and not is_known:
            return (
                f"the scale is known to {100 * min(scale_sigma, 9.99):.1f} %, "
                f"{100 * limits.scale_sigma:.1f} % are needed: change speed and direction more"
            )
        return ""

    def _contradiction(self, refined: refinement.Refined) -> str:
        """Return what images and samples say against each other; empty when they agree."""
        options = self._options
        if refined.median_error_px > options.max_error_px:
            return (
                f"images and IMU disagree by {refined.median_error_px:.1f} px, "
                f"{options.max_error_px:g} are allowed: check the time offset and the pose of the "
                "camera on the IMU, and that the scene does not move"
            )
        bias = float(np.linalg.norm(refined.states.accel_bias[-1]))
        if bias > _MAX_BIAS_SIGMAS * self._accel_bias_sigma:
            return (
                f"the accelerometer's bias would be {bias:.1f} m/s^2: change speed and direction, "
                "and turn; if this stays, calibrate the IMU"
            )
        return ""


def accel_bias_sigma(imu: Imu, options: InitializationOptions) -> float:
    """Return the standard deviation [m/s^2] of a component of the accelerometer's bias at the start.

    Sensors whose bias walks far are those that begin far off (Tango: 0.8 m/s^2).
    """
    walked = imu.acc_bias_random_walk_noise_density * float(np.sqrt(_BIAS_WALK_S))
    return max(options.accel_bias_sigma_mps2, min(walked, _MOST_ACCEL_BIAS_MPS2))


def shares_points(rays: SegmentRays) -> bool:
    """Tell whether most frames have points that several cameras see, which gives the scale."""
    order = np.lexsort((rays.frame, rays.track))
    same = (np.diff(rays.frame[order]) == 0) & (np.diff(rays.track[order]) == 0)
    frames = len(np.unique(rays.frame))
    shared = np.bincount(rays.frame[order][1:][same], minlength=1)
    return bool(np.count_nonzero(shared >= 10) >= 0.5 * max(frames, 1))


def _states(turns: Turns, gyro_bias: F64, motion: linear.LinearMotion) -> WindowStates:
    """Return the states of the frames in M."""
    q_M_A, frames = refinement.mission_frame(motion.g_A), len(turns.q_A_I)
    T_M_I = se3.make(so3.multiply(q_M_A, turns.q_A_I), so3.rotate(q_M_A, motion.p_A))
    biases = np.tile(np.concatenate([gyro_bias, motion.accel_bias]), (frames, 1))
    velocity = so3.rotate(q_M_A, motion.v_A)
    return WindowStates(T_M_I, np.concatenate([velocity, biases], axis=1), np.zeros((0, 3)))


def _start_state(time_ns: I64, refined: refinement.Refined) -> StartState:
    """Return the state of the last frame, in a mission frame that begins there."""
    T_M_I, motion = refined.states.T_M_I[-1:].copy(), refined.states.motion[-1:]
    T_M_I[:, 4:] = 0.0
    sigma = np.sqrt(np.maximum(np.diagonal(refined.covariance), 0.0))
    # heading is free to choose: what is known of it is what is known of the tilt
    sigma[:3], sigma[3:6] = _POSITION_SIGMA_M, refined.tilt_sigma_rad
    v_M, gyro_bias, accel_bias = np.split(motion, 3, axis=1)
    return StartState(time_ns, T_M_I, v_M, gyro_bias, accel_bias, sigma)
