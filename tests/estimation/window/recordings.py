"""Simulated sessions as frames of the smoother, with the truth."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.window.frame import Motion, StartState, WindowFrame
from maplab_py.interop.recordings.protocol import RecordedSensors
from maplab_py.sensors import Camera, Imu
from maplab_py.simulation.scenario import (
    CameraOptions,
    ImuOptions,
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.simulate import RecordedSession, simulate
from tests.support.noiseless import without_noise

F64 = NDArray[np.float64]
STEREO = (
    CameraOptions(position_m=(0.05, 0.055, 0.01), turn_rad=(0.004, -0.006, 0.003)),
    CameraOptions(position_m=(0.05, -0.055, 0.01), turn_rad=(-0.003, 0.004, -0.005)),
)


@dataclasses.dataclass(frozen=True, eq=False)
class SimulatedTracks:
    """What a front-end would deliver, and the truth."""

    frames: list[WindowFrame]
    cameras: tuple[Camera, ...]
    T_I_C: F64
    imu: Imu
    T_M_I: F64  # (F, 7) true, M being the simulator's G
    v_M: F64  # (F, 3)
    gyro_bias: F64  # (F, 3)
    accel_bias: F64  # (F, 3)
    point: NDArray[np.int64]  # (T,) point of the world that each track id observes
    p_G: F64  # (P, 3) points of the world
    device: RecordedSensors

    def start_state(self, sigma: F64, rng: np.random.Generator | None = None) -> StartState:
        """Return the true state of the first frame, with errors of the given deviations."""
        from maplab_py.geometry import se3

        error = np.zeros(15) if rng is None else sigma * rng.standard_normal(15)
        return StartState(
            np.array([self.frames[0].time_ns]),
            se3.retract(self.T_M_I[:1], error[None, :6]),
            self.v_M[:1] + error[6:9],
            self.gyro_bias[:1] + error[9:12],
            self.accel_bias[:1] + error[12:],
            sigma,
        )


def scenario(
    *,
    seed: int = 1,
    duration_s: float = 8.0,
    stereo: bool = True,
    noise: bool = True,
    rate_hz: float = 10.0,
    kind: str = "room_scan",
    keypoints: int = 150,
    landmarks_per_room: int = 1500,
    imu_rate_hz: float = 200.0,
) -> Scenario:
    """Return a room walked through with a rig."""
    result = Scenario(
        name="window",
        world=WorldOptions(room_size_m=(8.0, 6.5, 3.0), landmarks_per_room=landmarks_per_room),
        imu=ImuOptions(rate_hz=imu_rate_hz),
        cameras=STEREO if stereo else STEREO[:1],
        measurement=MeasurementOptions(
            frame_rate_hz=rate_hz,
            max_keypoints=keypoints,
            detection_probability=0.97,
            track_break_probability=0.01,
            identity_swap_share=0.0,
        ),
        sessions=(SessionOptions(kind=kind, duration_s=duration_s, turns=0.05 * duration_s),),
    ).with_seed(seed)
    return result if noise else without_noise(result)


def simulated(options: Scenario) -> SimulatedTracks:
    """Record the first session of a scenario."""
    data = simulate(options)
    return _tracks(options, data.recordings[0], data.world.p_G)


def _tracks(options: Scenario, session: RecordedSession, p_G: F64) -> SimulatedTracks:
    device, recording = session.device, session.recording
    seen, cameras = recording.keypoints, len(device.rig.cameras)
    frame, camera = np.divmod(seen.frame, cameras)
    track = _track_ids(seen.point, frame)
    sigma = np.full(len(frame), max(options.measurement.keypoint_sigma_px, 0.5))
    frames = []
    for number, time_ns in enumerate(recording.time_ns.tolist()):
        rows = np.flatnonzero((frame == number) & (seen.point >= 0))
        first = recording.imu_row[max(number - 1, 0)]
        samples = slice(first, recording.imu_row[number] + 1)
        frames.append(
            WindowFrame(
                time_ns, recording.imu_time_ns[samples], recording.imu.accel_gyro[samples],
                camera[rows].astype(np.int32), track[rows], seen.uv_px[rows], sigma[rows],
                Motion.MOVING,
            )
        )  # fmt: skip
    row, rig = recording.imu_row, device.rig
    return SimulatedTracks(
        frames, rig.cameras, device.sensor_set.T_I_C(device.imu_id, rig.id),
        device.sensor_set.imu(device.imu_id), recording.motion.T_G_I, recording.motion.v_G,
        recording.imu.gyro_bias[row], recording.imu.accel_bias[row],
        _points_of_tracks(seen.point, track), p_G,
        RecordedSensors(device.sensor_set, rig.id, device.imu_id),
    )  # fmt: skip


def _points_of_tracks(point: NDArray[np.int64], track: NDArray[np.int64]) -> NDArray[np.int64]:
    points = np.full(track.max() + 1, -1, dtype=np.int64)
    points[track] = point
    return points


def _track_ids(point: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number points seen in consecutive frames by whichever camera, in the order they appear."""
    order = np.lexsort((frame, point))
    begins = np.ones(len(frame), dtype=np.bool_)
    begins[1:] = (np.diff(point[order]) != 0) | (np.diff(frame[order]) > 1)
    track = np.empty(len(frame), dtype=np.int64)
    track[order] = np.cumsum(begins) - 1
    return track
