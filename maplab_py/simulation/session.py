"""One session: what its sensors record, as a map with drifting states, and its truth."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.geometry import se3
from maplab_py.geometry.triangulation import triangulate
from maplab_py.sensors.projection import back_project
from maplab_py.simulation.appearance import SessionAppearance, describe
from maplab_py.simulation.detection import Detections, camera_poses, detect
from maplab_py.simulation.drift import DriftedStates, baseframe, drift, mission_frame
from maplab_py.simulation.imu import ImuRecording, measure
from maplab_py.simulation.motion import motion_spline
from maplab_py.simulation.scenario import MotionOptions, Scenario
from maplab_py.simulation.sensors import SimulatedSensors
from maplab_py.simulation.spline import MotionState
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import from_hex, random_ids
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vimap.tables import (
    BaseFrames,
    FrameField,
    Frames,
    ImuEdges,
    ImuSamples,
    Keypoints,
    Landmarks,
    Missions,
    MissionSensor,
    Vertices,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_EPOCH_NS = 1_600_000_000_000_000_000
_SESSION_GAP_NS = 3_600_000_000_000
_MIN_RAY_ANGLE_RAD = np.deg2rad(0.5)
_MAX_LANDMARK_DISTANCE_M = 60.0
_KEYPOINT_SCALE = 20.0
_MIN_SIGMA_PX = 0.1
"""Standard deviation that perfect keypoints announce, so that they can be weighed."""


@dataclasses.dataclass(frozen=True, eq=False)
class SessionSeeds:
    """One generator per kind of chance."""

    motion: np.random.Generator
    measurement: np.random.Generator
    appearance: np.random.Generator
    ids: np.random.Generator


@dataclasses.dataclass(frozen=True, eq=False)
class _Recording:
    """Everything that was recorded, at the vertices unless said otherwise."""

    time_ns: I64  # (V,)
    motion: MotionState
    states: DriftedStates
    imu_time_ns: I64  # (S,) of all samples
    imu: ImuRecording  # of all samples
    imu_row: I64  # (V,) sample at the vertex
    keypoints: Detections  # of all cameras; `frame` counts vertex * cameras + camera
    descriptors: NDArray[np.uint8]


def simulate_session(
    scenario: Scenario,
    number: int,
    world: World,
    sensors: SimulatedSensors,
    appearance: SessionAppearance,
    seeds: SessionSeeds,
) -> tuple[VIMap, Truth]:
    """Record one session and return its map and its truth.

    Args:
        scenario: The whole scenario.
        number: Which of its sessions.
        world: The world that all sessions share.
        sensors: The device that all sessions share.
        appearance: How the world looks in this session.
        seeds: Generators of this session.
    """
    options = scenario.sessions[number]
    recording = _record(scenario, number, options, world, sensors, appearance, seeds)
    landmarks, landmark_of, point_of = _triangulate(scenario, sensors, recording, seeds)
    vi_map = _assemble(scenario, sensors, recording, landmarks, landmark_of, seeds)
    return vi_map, _truth(vi_map, recording, world, point_of)


def _record(
    scenario: Scenario,
    number: int,
    options: MotionOptions,
    world: World,
    sensors: SimulatedSensors,
    appearance: SessionAppearance,
    seeds: SessionSeeds,
) -> _Recording:
    room = np.asarray(scenario.world.room_size_m) if options.kind != "loop" else world.extent_m
    spline = motion_spline(options, room, seeds.motion)
    rate = scenario.imu.rate_hz
    samples = int(np.floor(options.duration_s * rate)) + 1
    sample_time = np.arange(samples) / rate
    imu = measure(scenario.imu, spline.evaluate(sample_time), seeds.measurement)
    frame_rate = scenario.measurement.frame_rate_hz
    frames = int(np.floor(options.duration_s * frame_rate)) + 1
    row = np.unique(np.minimum(np.round(np.arange(frames) * rate / frame_rate), samples - 1))
    row = row.astype(np.int64)
    motion = spline.evaluate(sample_time[row])
    states = drift(scenario.drift, motion, sample_time[row], seeds.measurement)
    found = _detect_all(scenario, world, sensors, motion.T_G_I, appearance, seeds)
    begin_ns = _EPOCH_NS + number * _SESSION_GAP_NS
    time_ns = begin_ns + np.round(sample_time * 1e9).astype(np.int64)
    descriptors = describe(appearance, found, seeds.appearance)
    return _Recording(time_ns[row], motion, states, time_ns, imu, row, found, descriptors)


def _detect_all(
    scenario: Scenario,
    world: World,
    sensors: SimulatedSensors,
    T_G_I: F64,
    appearance: SessionAppearance,
    seeds: SessionSeeds,
) -> Detections:
    """Detect with every camera; images and tracks are numbered over all cameras."""
    cameras = sensors.rig.cameras
    parts, tracks = [], 0
    for row, camera in enumerate(cameras):
        poses = camera_poses(T_G_I, sensors.rig.T_B_C[row])
        found = detect(
            camera, poses, world, appearance.is_there, scenario.measurement, seeds.measurement
        )
        track = np.where(found.track >= 0, found.track + tracks, -1)
        tracks = max(tracks, int(track.max(initial=-1)) + 1)
        frame = found.frame * len(cameras) + row
        parts.append(dataclasses.replace(found, frame=frame, track=track))
    names = [field.name for field in dataclasses.fields(Detections)]
    joined = {n: np.concatenate([getattr(part, n) for part in parts]) for n in names}
    order = np.argsort(joined["frame"], kind="stable")
    return Detections(**{n: column[order] for n, column in joined.items()})


def _triangulate(
    scenario: Scenario, sensors: SimulatedSensors, recording: _Recording, seeds: SessionSeeds
) -> tuple[Landmarks, I64, I64]:
    """Triangulate tracks from the drifted poses, as the odometry would have done.

    Returns:
        Landmarks, the landmark row of every keypoint (-1 = none), and the world point of every
        landmark (L,).
    """
    found, cameras = recording.keypoints, len(sensors.rig.cameras)
    tracked = np.flatnonzero(found.track >= 0)
    order = tracked[np.argsort(found.track[tracked], kind="stable")]
    length = np.bincount(found.track[tracked])
    start = starts_of_counts(length)
    vertex = found.frame // cameras
    T_M_C, ray_C = _rays(sensors, recording)
    ray_M = se3.transform(np.concatenate([T_M_C[:, :4], np.zeros((len(T_M_C), 3))], axis=1), ray_C)
    p_M, ok, angle = triangulate(T_M_C[order, 4:], ray_M[order], start)
    p_of = np.repeat(p_M, length, axis=0)
    offset = p_of - T_M_C[order, 4:]
    behind = np.sum(offset * ray_M[order], axis=1) <= 0.0
    far = np.linalg.norm(offset, axis=1) > _MAX_LANDMARK_DISTANCE_M
    bad = np.bincount(np.repeat(np.arange(len(length)), length), behind | far, len(length)) > 0
    ok &= (length >= scenario.measurement.min_track_length) & ~bad
    ok &= angle > _MIN_RAY_ANGLE_RAD
    kept = np.flatnonzero(ok)
    row_of_track = np.full(len(length), -1, dtype=np.int64)
    row_of_track[kept] = np.arange(len(kept))
    landmark_of = np.full(len(found.track), -1, dtype=np.int64)
    landmark_of[tracked] = row_of_track[found.track[tracked]]
    first = order[start[kept]]
    T_M_I = recording.states.T_M_I[vertex[first]]
    landmarks = Landmarks.filled(
        len(kept),
        id=random_ids(len(kept), seeds.ids),
        vertex=vertex[first],
        p_I=se3.transform(se3.inverse(T_M_I), p_M[kept]),
    )
    # the median of a track's points is the point that most of it shows
    middle = start[kept] + length[kept] // 2
    by_point = order[np.lexsort((found.point[order], found.track[order]))]
    return landmarks, landmark_of, found.point[by_point[middle]]


def _rays(sensors: SimulatedSensors, recording: _Recording) -> tuple[F64, F64]:
    """Return the believed camera pose (N, 7) and the measured ray (N, 3) of every keypoint."""
    found, cameras = recording.keypoints, sensors.rig.cameras
    camera_row = found.frame % len(cameras)
    T_M_I = recording.states.T_M_I[found.frame // len(cameras)]
    rays = np.empty((len(found.frame), 3))
    for row, camera in enumerate(cameras):
        own = camera_row == row
        rays[own] = back_project(camera, found.uv_px[own])[0]
    return se3.compose(T_M_I, sensors.rig.T_B_C[camera_row]), rays


def _assemble(
    scenario: Scenario,
    sensors: SimulatedSensors,
    recording: _Recording,
    landmarks: Landmarks,
    landmark_of: I64,
    seeds: SessionSeeds,
) -> VIMap:
    vertices = len(recording.time_ns)
    sensor_id = np.zeros((1, len(MissionSensor), 2), dtype=np.uint64)
    sensor_id[0, MissionSensor.IMU] = from_hex(sensors.imu_id)
    sensor_id[0, MissionSensor.NCAMERA] = from_hex(sensors.rig.id)
    bias_error = seeds.measurement.standard_normal((2, 3))
    edges, samples = _imu_tables(recording, seeds)
    frames, keypoints = _image_tables(scenario, sensors, recording, landmark_of, seeds)
    T_G_M = baseframe(scenario.drift, seeds.measurement)
    mission_id, frame_id = random_ids(1, seeds.ids), random_ids(1, seeds.ids)
    return VIMap(
        sensors=sensors.sensor_set,
        missions=Missions.filled(
            1, id=mission_id, baseframe=[0], root_vertex=[0], sensor_id=sensor_id
        ),
        baseframes=BaseFrames.filled(1, id=frame_id, T_G_M=T_G_M[None]),
        vertices=Vertices.filled(
            vertices,
            id=random_ids(vertices, seeds.ids),
            mission=np.zeros(vertices, dtype=np.int32),
            T_M_I=recording.states.T_M_I,
            v_M=recording.states.v_M,
            accel_bias=recording.imu.accel_bias[recording.imu_row]
            + scenario.drift.accel_bias_sigma * bias_error[0],
            gyro_bias=recording.imu.gyro_bias[recording.imu_row]
            + scenario.drift.gyro_bias_sigma * bias_error[1],
            timestamp_ns=recording.time_ns,
            nframe_id=random_ids(vertices, seeds.ids),
        ),
        frames=frames,
        keypoints=keypoints,
        landmarks=landmarks,
        imu_edges=edges,
        imu_samples=samples,
    )


def _imu_tables(recording: _Recording, seeds: SessionSeeds) -> tuple[ImuEdges, ImuSamples]:
    """Cut the recording at the vertices; neighbouring edges share the sample between them."""
    row = recording.imu_row
    count = np.diff(row) + 1
    edges = len(count)
    # edge e has the samples row[e] .. row[e + 1], both included
    first = np.repeat(row[:-1] - starts_of_counts(count)[:-1], count)
    rows = first + np.arange(int(count.sum()))
    table = ImuEdges.filled(
        edges,
        id=random_ids(edges, seeds.ids),
        from_vertex=np.arange(edges),
        to_vertex=np.arange(1, edges + 1),
        sample_count=count,
    )
    samples = ImuSamples.filled(
        len(rows),
        timestamp_ns=recording.imu_time_ns[rows],
        accel_gyro=recording.imu.accel_gyro[rows],
    )
    return table, samples


def _image_tables(
    scenario: Scenario,
    sensors: SimulatedSensors,
    recording: _Recording,
    landmark_of: I64,
    seeds: SessionSeeds,
) -> tuple[Frames, Keypoints]:
    found, cameras = recording.keypoints, len(sensors.rig.cameras)
    vertices = len(recording.time_ns)
    count = vertices * cameras
    present = FrameField.SIGMA | FrameField.SCALE | FrameField.TRACK_ID | FrameField.LANDMARK_ID
    frames = Frames.filled(
        count,
        id=random_ids(count, seeds.ids),
        vertex=np.repeat(np.arange(vertices), cameras),
        camera_index=np.tile(np.arange(cameras), vertices),
        timestamp_ns=np.repeat(recording.time_ns, cameras),
        keypoint_count=np.bincount(found.frame, minlength=count),
        descriptor_size=np.full(count, recording.descriptors.shape[1]),
        present=np.full(count, int(present)),
    )
    sigma = max(scenario.measurement.keypoint_sigma_px, _MIN_SIGMA_PX)
    keypoints = Keypoints.filled(
        len(found.frame),
        uv_px=found.uv_px,
        sigma_px=np.full(len(found.frame), sigma),
        scale=np.full(len(found.frame), _KEYPOINT_SCALE),
        track_id=found.track,
        landmark=landmark_of,
        descriptor=recording.descriptors,
    )
    return frames, keypoints


def _truth(vi_map: VIMap, recording: _Recording, world: World, point_of: I64) -> Truth:
    row = recording.imu_row
    return Truth(
        mission_id=vi_map.missions.id,
        T_G_M=mission_frame(recording.motion.T_G_I[0])[None],
        vertex_id=vi_map.vertices.id,
        vertex_mission=np.zeros(len(row), dtype=np.int64),
        vertex_time_ns=recording.time_ns,
        T_G_I=recording.motion.T_G_I,
        v_G=recording.motion.v_G,
        accel_bias=recording.imu.accel_bias[row],
        gyro_bias=recording.imu.gyro_bias[row],
        landmark_id=vi_map.landmarks.id,
        landmark_point=point_of,
        point_G=world.p_G,
    )
