"""Segments of simulated sessions as they leave the window of an odometry."""

import dataclasses
import functools

import numpy as np

from maplab_py.frontend.recorded_mission import RecordedMission
from maplab_py.interop.device import RecordedSensors
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.interop.recordings.protocol import ImuBatch, TrackedFrame, TrackedFrameSet
from maplab_py.online_calibration.process import OPTIONS, Piece
from maplab_py.simulation.scenario import CalibrationOptions, ImuOptions, MotionOptions, Scenario
from maplab_py.simulation.scenario import SessionOptions as Session
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from maplab_py.vimap.nav_state import NavState

LIVELY = MotionOptions(
    kind="figure_8", duration_s=12.1, turns=0.3, height_m=1.4, shake_m=0.06, shake_rad=0.25
)
"""Three segments."""


def device_scenario(*phases: MotionOptions, seed: int = 1) -> Scenario:
    """Return a session of a device that is as its calibration says."""
    scenario = load_scenario("ar_room")
    measurement = dataclasses.replace(scenario.measurement, max_keypoints=80)
    return dataclasses.replace(
        scenario,
        calibration=CalibrationOptions(),
        measurement=measurement,
        sessions=(Session(phases=phases),),
    ).with_seed(seed)


@functools.cache
def session(gyro_scale: float = 1.0, seed: int = 1) -> VIMap:
    """Return the map of a session whose gyroscope has another scale than its calibration says."""
    plain = device_scenario(LIVELY, seed=seed)
    scales = (gyro_scale, gyro_scale, gyro_scale)
    imu = dataclasses.replace(plain.imu, gyro_scale=scales)
    vi_map = simulate(dataclasses.replace(plain, imu=imu)).maps[0]
    if imu == plain.imu or not isinstance(imu, ImuOptions):
        return vi_map
    still = MotionOptions(kind="stationary", duration_s=0.5)
    nominal = simulate(device_scenario(still, seed=seed)).maps[0].sensors
    return vi_map.replace(sensors=nominal)


def recorded(vi_map: VIMap) -> tuple[RecordedSensors, RecordedMission]:
    """Return the device and what an odometry with the map's states would have recorded."""
    recording, mission = MapRecording(vi_map, 0), RecordedMission()
    v = vi_map.vertices
    states = NavState(v.timestamp_ns, v.T_M_I, v.v_M, v.gyro_bias, v.accel_bias)
    batches = [item for item in recording.items() if isinstance(item, ImuBatch)]
    times_ns = np.concatenate([batch.times_ns for batch in batches])
    samples = np.concatenate([batch.accel_gyro for batch in batches])
    sets = [item for item in recording.items() if isinstance(item, TrackedFrameSet)]
    for row, frame_set in enumerate(sets):
        if row:
            inside = (times_ns >= v.timestamp_ns[row - 1]) & (times_ns <= v.timestamp_ns[row])
            mission.add_imu(times_ns[inside], samples[inside])
        mission.add_vertex(states.row(row), tuple(map(_bare, frame_set.frames)), [-1])
    return recording.device, mission


def pieces(vi_map: VIMap) -> tuple[RecordedSensors, list[Piece]]:
    """Return the device and the segments of a session."""
    device, mission = recorded(vi_map)
    step = OPTIONS.segment_keyframes - 1
    starts = range(0, len(mission) - step, step)
    name = f"session {mission.edges[0][1].tobytes().hex()}"
    return device, [Piece(name, mission.part(row, row + step + 1)) for row in starts]


def _bare(frame: TrackedFrame | None) -> TrackedFrame | None:
    if frame is None:
        return None
    none = np.zeros((len(frame.uv_px), 0), dtype=np.uint8)
    return dataclasses.replace(frame, descriptor=none, descriptor_size=np.zeros(0, dtype=np.int32))
