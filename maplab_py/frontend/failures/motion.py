"""Comparison of the IMU and of single cameras with the motion that the images of half a second show.

The newest frame, one of half a second before and one in the middle get poses from their keypoints alone, by
landmarks as they were known at the first of them. The turn between the outer ones is compared with the
gyroscope's, the second difference of the positions with the accelerometer's: neither needs a velocity.
"""

import collections
import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import Preintegrated, integrate
from maplab_py.estimation.window.frame import ImuPart
from maplab_py.frontend.imu_buffer import joined_samples
from maplab_py.geometry import se3, so3
from maplab_py.interop.device import RecordedSensors
from maplab_py.sensors import Imu
from maplab_py.vision.tracking.ray_table import RayTable

SPAN_NS, _STEP_NS = 500_000_000, 250_000_000
_FEWEST_POINTS, _MOST_POINTS = 12, 100
_ROUNDS = 4
_CAUCHY_RAD = 3e-3
_RAY_SIGMA_RAD, _LEAST_INFORMATION = 1e-3, 1e-6
"""Noise of rays and landmarks, from which the uncertainty of a pose follows."""
_FIT_RAD = 0.02
"""Largest median angle between rays and landmarks of a pose that counts."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sighting:
    """Keypoints of a frame, and the samples that lead to it."""

    time_ns: int
    camera: I32  # (K,)
    track_id: I64  # (K,)
    uv_px: F64  # (K, 2)
    late_s: F64  # (K,) later than the frame
    twist_I: F64  # (6,) velocity and angular velocity
    times_ns: I64  # (S,)
    accel_gyro: F64  # (S, 6) as measured


@dataclasses.dataclass(frozen=True, eq=False)
class _Snapshot:
    """A frame with the landmarks and biases that were known then."""

    time_ns: int
    track_id: I64
    p_M: F64  # (L, 3)
    T_M_I: F64  # (7,)
    biases: tuple[F64, F64]  # of gyroscope and accelerometer


@dataclasses.dataclass(frozen=True, eq=False)
class Disagreement:
    """Measured minus seen."""

    rate: F64  # (3,) [rad/s] in I
    acceleration: F64  # (3,) [m/s^2] in I
    since_ns: int
    biases: dict[ImuPart, F64]  # that were taken from the samples
    sigma: dict[ImuPart, float]  # of rate and acceleration, by noise of the keypoints
    fit_rad: F64  # (C,) median angle between rays and landmarks in the newest frame; nan = too few


class MotionComparison:
    """Keeps frames of the last half second, and compares."""

    def __init__(self, device: RecordedSensors, imu: Imu) -> None:
        self._imu, self._T_I_C = imu, device.T_I_C
        self._tables = [RayTable.of(camera) for camera in device.cameras]
        self._frames: collections.deque[Sighting] = collections.deque()
        self._snapshots: collections.deque[_Snapshot] = collections.deque()
        self._next_ns = 0

    def push(self, sighting: Sighting) -> None:
        """Take a frame."""
        self._frames.append(sighting)
        while self._frames[0].time_ns < sighting.time_ns - 2 * SPAN_NS:
            self._frames.popleft()

    def is_due(self, time_ns: int) -> bool:
        """Tell whether it is time to compare, and to remember landmarks."""
        return time_ns >= self._next_ns

    def remember(
        self, landmarks: tuple[I64, F64], T_M_I: F64, biases: tuple[F64, F64], T_I_C: F64
    ) -> None:
        """Remember landmarks at the newest frame, with its pose and biases, and poses (C, 7) of cameras."""
        self._T_I_C = T_I_C
        time_ns = self._frames[-1].time_ns
        self._next_ns = time_ns + _STEP_NS
        ids, p_M = landmarks
        order = np.argsort(ids, kind="stable")
        self._snapshots.append(_Snapshot(time_ns, ids[order], p_M[order], T_M_I, biases))
        while (
            len(self._snapshots) > 1 and self._snapshots[1].time_ns <= time_ns - SPAN_NS + _STEP_NS
        ):
            self._snapshots.popleft()

    def compared(self, cameras: frozenset[int]) -> Disagreement | None:
        """Compare the newest frame with one of half a second before, by some cameras; None = unknown."""
        if not self._snapshots or not self._frames:
            return None
        snapshot, newest = self._snapshots[0], self._frames[-1]
        if newest.time_ns - snapshot.time_ns < SPAN_NS // 2:
            return None
        span = [f for f in self._frames if snapshot.time_ns <= f.time_ns]
        if len(span) < 3 or span[0].time_ns != snapshot.time_ns:
            return None
        middle = min(range(1, len(span) - 1), key=lambda row: abs(
            2 * span[row].time_ns - snapshot.time_ns - newest.time_ns))  # fmt: skip
        poses, covariances = [], []
        T_M_I, fit = snapshot.T_M_I, np.zeros(0)
        for frame in (span[0], span[middle], span[-1]):
            pose = self._pose(frame, snapshot, T_M_I, cameras)
            if pose is None:
                return None
            T_M_I, fit, covariance = pose
            poses.append(T_M_I)
            covariances.append(covariance)
        legs = self._integrated([span[1 : middle + 1], span[middle + 1 :]], snapshot.biases)
        rate, acceleration = _compare(np.array(poses), legs, self._imu)
        parts = ImuPart.GYROSCOPE, ImuPart.ACCELEROMETER
        biases = dict(zip(parts, snapshot.biases, strict=True))
        sigma = dict(zip(parts, _sigmas(np.array(covariances), legs.duration_s), strict=True))
        return Disagreement(rate, acceleration, snapshot.time_ns, biases, sigma, fit)

    def _pose(
        self, frame: Sighting, snapshot: _Snapshot, T_M_I: F64, cameras: frozenset[int]
    ) -> tuple[F64, F64, F64] | None:
        """Return the pose T_M_I (7,) of a frame by its keypoints, the fit of every camera, and covariance."""
        row = np.searchsorted(snapshot.track_id, frame.track_id)
        row = np.minimum(row, max(len(snapshot.track_id) - 1, 0))
        is_known: Mask = np.isin(frame.camera, list(cameras))
        is_known &= len(snapshot.track_id) > 0
        if is_known.any():
            is_known &= snapshot.track_id[row] == frame.track_id
        if np.count_nonzero(is_known) < _FEWEST_POINTS:
            return None
        used = np.flatnonzero(is_known)
        used = used[:: 1 + len(used) // _MOST_POINTS]
        ray_C, exists = np.empty((len(used), 3)), np.zeros(len(used), dtype=np.bool_)
        for number in cameras:
            rows = frame.camera[used] == number
            ray_C[rows], exists[rows] = self._tables[number].rays(frame.uv_px[used[rows]])
        used, ray_C = used[exists], ray_C[exists]
        if len(used) < _FEWEST_POINTS // 2:
            return None
        camera, p_M = frame.camera[used], snapshot.p_M[row[used]]
        T_I_C, late_s = self._T_I_C[camera], frame.late_s[used, None]
        ray_I, p_I_C = so3.rotate(T_I_C[:, :4], ray_C), T_I_C[:, 4:]
        if late_s.any():
            turn = so3.exp(late_s * frame.twist_I[3:])
            ray_I = so3.rotate(turn, ray_I)
            p_I_C = so3.rotate(turn, p_I_C) + late_s * frame.twist_I[:3]
        T_M_I = pose_by_rays(p_M, ray_I, p_I_C, T_M_I)
        residual, jacobian = _residual(T_M_I, p_M, ray_I, p_I_C)
        angle = np.linalg.norm(residual, axis=1)
        if float(np.median(angle)) > _FIT_RAD:
            return None
        fit = [
            float(np.median(angle[camera == number])) if np.any(camera == number) else np.nan
            for number in range(len(self._tables))
        ]
        near = jacobian[angle < _CAUCHY_RAD]
        information = np.einsum("kij,kil->jl", near, near)
        information[np.diag_indices(6)] += _LEAST_INFORMATION
        return T_M_I, np.array(fit), _RAY_SIGMA_RAD**2 * np.linalg.inv(information)

    def _integrated(self, legs: list[list[Sighting]], biases: tuple[F64, F64]) -> Preintegrated:
        """Integrate the samples of two legs."""
        edges = [joined_samples([(f.times_ns, f.accel_gyro) for f in leg]) for leg in legs]
        return integrate(InertialData.of_samples(self._imu, edges), *biases)


def _compare(T_M_I: F64, legs: Preintegrated, imu: Imu) -> tuple[F64, F64]:
    """Return rate and acceleration of two legs minus those of the poses (3, 7) at their ends."""
    dt, g_M = legs.duration_s, np.array([0.0, 0.0, -imu.gravity_magnitude_mps2])
    seen = so3.multiply(so3.inverse(T_M_I[0, :4]), T_M_I[2, :4])
    measured = so3.multiply(legs.q_A_B[0], legs.q_A_B[1])
    rate = so3.log(so3.multiply(so3.inverse(seen), measured)) / dt.sum()
    # without v_0: p_1 = p_0 + v_0 t + g t^2 / 2 + R_0 dp_0, and p_2 likewise with v_1 = v_0 + g t + R_0 dv_0
    steps = (T_M_I[1:, 4:] - T_M_I[:-1, 4:]) / dt[:, None]
    by_samples = (
        0.5 * g_M * dt.sum()
        + so3.rotate(T_M_I[0, :4], legs.dv[0] - legs.dp[0] / dt[0])
        + so3.rotate(T_M_I[1, :4], legs.dp[1] / dt[1])
    )
    acceleration_M = (by_samples - (steps[1] - steps[0])) / (0.5 * dt.sum())
    return rate, so3.rotate(so3.inverse(T_M_I[1, :4]), acceleration_M)


def _sigmas(covariance: F64, dt: F64) -> tuple[float, float]:
    """Return the deviations of rate and acceleration, from those of poses (3, 6, 6) at the ends of legs."""
    turn = np.trace(covariance[:, :3, :3], axis1=1, axis2=2)
    position = np.trace(covariance[:, 3:, 3:], axis1=1, axis2=2)
    of_steps = np.array([1.0 / dt[0], np.sum(1.0 / dt), 1.0 / dt[1]]) / (0.5 * dt.sum())
    return float(np.sqrt(turn[0] + turn[2]) / dt.sum()), float(np.sqrt(of_steps**2 @ position))


def pose_by_rays(p_M: F64, ray_I: F64, p_I_C: F64, T_M_I: F64) -> F64:
    """Return the pose (7,) at which points (K, 3) are seen along unit rays (K, 3) in I; Cauchy's loss.

    Args:
        p_M: Points.
        ray_I: Rays.
        p_I_C: Positions (K, 3) of the cameras.
        T_M_I: Where to begin.
    """
    for _ in range(_ROUNDS):
        residual, jacobian = _residual(T_M_I, p_M, ray_I, p_I_C)
        weight = 1.0 / (1.0 + np.einsum("ki,ki->k", residual, residual) / _CAUCHY_RAD**2)
        weighted = (weight[:, None, None] * jacobian).reshape(-1, 6)
        H, g = weighted.T @ jacobian.reshape(-1, 6), weighted.T @ residual.ravel()
        H[np.diag_indices(6)] += 1e-6
        step = -np.linalg.solve(H, g)
        q = so3.normalize(so3.multiply(T_M_I[:4], so3.exp(step[:3])))
        T_M_I = se3.make(q, T_M_I[4:] + step[3:])
    return T_M_I


def _residual(T_M_I: F64, p_M: F64, ray_I: F64, p_I_C: F64) -> tuple[F64, F64]:
    """Return unit vectors to points minus rays (K, 3) in I; derivatives (K, 3, 6) by turn and p_M_I."""
    R_I_M = so3.to_matrix(T_M_I[:4]).T
    p_I = (p_M - T_M_I[4:]) @ R_I_M.T
    d = p_I - p_I_C
    length = np.maximum(np.linalg.norm(d, axis=1), 1e-6)
    u = d / length[:, None]
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / length[:, None, None]
    jacobian = np.empty((len(p_M), 3, 6))
    jacobian[:, :, :3] = across @ so3.skew(p_I)
    jacobian[:, :, 3:] = -across @ R_I_M
    return u - ray_I, jacobian
