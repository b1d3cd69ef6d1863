"""Flights with known truth, as frames of tracked keypoints and IMU samples."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.window.frame import WindowFrame
from maplab_py.geometry import se3, so3
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import (
    Camera,
    CameraRig,
    Distortion,
    Extrinsics,
    Imu,
    ImuIntrinsics,
    Projection,
    SensorSet,
)
from maplab_py.sensors.projection import is_inside_image, project
from maplab_py.simulation.imu import measure
from maplab_py.simulation.scenario import ImuOptions
from maplab_py.simulation.spline import MotionState, PoseSpline

IMAGE_HZ, IMU_HZ = 20.0, 200.0
NOISE_PX = 0.5
EXACT_IMU = ImuOptions(
    rate_hz=IMU_HZ,
    gyro_noise_density=0.0,
    accel_noise_density=0.0,
    gyro_bias_walk=0.0,
    accel_bias_walk=0.0,
    gyro_bias_sigma=0.03,
    accel_bias_sigma=0.05,
)
"""Without noise, with biases."""
_SPACING_S = 0.1
_Q_I_C = so3.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


@dataclasses.dataclass(frozen=True, eq=False)
class Flight:
    device: RecordedSensors
    frames: list[WindowFrame]
    truth: MotionState  # at the frames
    gyro_bias: F64  # (F, 3)
    accel_bias: F64  # (F, 3)


def device(cameras: int = 1, focal_px: float = 458.0) -> RecordedSensors:
    rig_id, imu_id = "a" * 32, "b" * 32
    models = tuple(
        Camera(
            f"{row + 1:032x}",
            Projection.PINHOLE,
            Distortion.RADTAN,
            np.array([focal_px, focal_px - 1.0, 367.0, 248.0]),
            np.array([-0.28, 0.07, 2e-4, 2e-5]),
            752,
            480,
        )
        for row in range(cameras)
    )
    side = 0.055 * np.array([1.0, -1.0])[:cameras]
    p = np.column_stack([np.full(cameras, 0.02), side, np.full(cameras, 0.03)])
    rig = CameraRig(rig_id, models, se3.make(np.tile(_Q_I_C, (cameras, 1)), p))
    sensors = SensorSet(
        {imu_id: Imu(imu_id, 2e-3, 1e-3, 1.7e-4, 2e-5), rig_id: rig},
        {rig_id: Extrinsics(imu_id, se3.identity())},
    )
    return RecordedSensors(sensors, rig_id, imu_id)


def lively(seed: int, seconds: float, metres: float = 0.5, turn_rad: float = 0.25) -> PoseSpline:
    """Return a motion of a few slow oscillations of place and attitude, from any heading."""
    rng = np.random.default_rng([seed, 7])
    time_s = (np.arange(int(np.ceil(seconds / _SPACING_S)) + 4) - 1) * _SPACING_S
    waves = np.zeros((len(time_s), 6))
    size = np.repeat([metres, turn_rad], 3) * [1.0, 1.0, 0.6, 0.7, 0.7, 1.0]
    for _ in range(3):
        hz, phase = rng.uniform(0.1, 0.5, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
        waves += size / 2.0 * np.sin(2.0 * np.pi * hz * time_s[:, None] + phase)
    q = so3.multiply(so3.exp(np.array([0, 0, rng.uniform(-3, 3)])), so3.exp(waves[:, 3:]))
    return PoseSpline(se3.make(q, waves[:, :3] + [0.0, 0.0, 1.5]), _SPACING_S)


def resting(seed: int, seconds: float) -> PoseSpline:
    start = lively(seed, 0.2).control[1]
    return PoseSpline(np.tile(start, (int(np.ceil(seconds / _SPACING_S)) + 4, 1)), _SPACING_S)


def creeping(seed: int, seconds: float, speed_mps: float, rate_radps: float) -> PoseSpline:
    """Return a slow steady motion: to the side, turning about the optical axis."""
    start = lively(seed, 0.2).control[1]
    time_s = np.arange(int(np.ceil(seconds / _SPACING_S)) + 4) * _SPACING_S
    turned = so3.exp(rate_radps * time_s[:, None] * np.array([1.0, 0.0, 0.0]))
    moved = speed_mps * time_s[:, None] * np.array([0.0, 1.0, 0.0])
    return PoseSpline(se3.compose(start, se3.make(turned, moved)), _SPACING_S)


def fly(
    spline: PoseSpline,
    *,
    seed: int = 0,
    cameras: int = 1,
    imu: ImuOptions | None = None,
    outlier_share: float = 0.03,
    points: int = 4000,
    focal_px: float = 458.0,
) -> Flight:
    """Record a motion: keypoints of points on a sphere shell, IMU samples with biases and noise."""
    rng, rig = np.random.default_rng([seed, 8]), device(cameras, focal_px)
    options = imu or ImuOptions(gyro_bias_sigma=0.03)
    count = int(spline.duration_s * IMU_HZ)
    sample_s = np.arange(count) / IMU_HZ
    recorded = measure(options, ImuIntrinsics(), spline.evaluate(sample_s), rng)
    direction = rng.standard_normal((points, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    p_G = spline.control[:, 4:].mean(axis=0) + direction * rng.uniform(2.0, 7.0, (points, 1))
    step = int(IMU_HZ / IMAGE_HZ)
    rows = np.arange(0, count, step)
    truth = spline.evaluate(sample_s[rows])
    sample_ns = np.round(sample_s * 1e9).astype(np.int64) + 10**15
    frames = []
    for k, row in enumerate(rows.tolist()):
        samples = slice(max(row - step, 0), row + 1)
        camera, track, uv = _look(rig, truth.T_G_I[k], p_G, outlier_share, rng)
        frames.append(
            WindowFrame(
                time_ns=int(sample_ns[row]),
                imu_times_ns=sample_ns[samples],
                accel_gyro=recorded.accel_gyro[samples],
                camera=camera.astype(np.int32),
                track_id=track,
                uv_px=uv,
                sigma_px=np.full(len(uv), 0.8),
            )
        )
    return Flight(rig, frames, truth, recorded.gyro_bias[rows], recorded.accel_bias[rows])


def _look(
    rig: RecordedSensors, T_G_I: F64, p_G: F64, outlier_share: float, rng: np.random.Generator
) -> tuple[I64, I64, F64]:
    """Return camera, track and pixel of some points in view; cameras see the same points."""
    cameras, tracks, pixels = [], [], []
    for row, camera in enumerate(rig.cameras):
        T_G_C = se3.compose(T_G_I, rig.T_I_C[row])
        uv, visible = project(camera, se3.transform(se3.inverse(T_G_C), p_G))
        seen = np.flatnonzero(visible & is_inside_image(camera, uv, 20.0))
        uv = uv[seen] + NOISE_PX * rng.standard_normal((len(seen), 2))
        wrong = rng.uniform(size=len(seen)) < outlier_share
        uv[wrong] += rng.uniform(-15.0, 15.0, (np.count_nonzero(wrong), 2))
        inside = is_inside_image(camera, uv)
        cameras.append(np.full(np.count_nonzero(inside), row))
        tracks.append(seen[inside])
        pixels.append(uv[inside])
    return np.concatenate(cameras), np.concatenate(tracks), np.concatenate(pixels)


def tilt_error_deg(T_M_I: F64, T_G_I: F64) -> float:
    """Return the angle between two directions of gravity, seen from the IMU."""
    up = [so3.to_matrix(T[:4])[2] for T in (T_M_I, T_G_I)]
    return float(np.degrees(np.arccos(np.clip(up[0] @ up[1], -1.0, 1.0))))


def body_velocity(T_M_I: F64, v_M: F64) -> F64:
    return so3.rotate(so3.inverse(T_M_I[:4]), v_M)
