"""One recorded session as a map with drifting states, and its truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64, U64, NDArray
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3, triangulation
from maplab_py.interop.text_table import format_rows
from maplab_py.output_files import write_text
from maplab_py.sensors import Extrinsics, OtherSensor, SensorSet, projection
from maplab_py.simulation import detection, truth
from maplab_py.simulation.recording import Recording, SessionSeeds
from maplab_py.simulation.scenario import OtherSensorOptions, Scenario
from maplab_py.simulation.sensors import Device, baseframe
from maplab_py.simulation.world import World
from maplab_py.vimap import TransformationKind, VIMap, descriptors, starts_of_counts, tables
from maplab_py.vimap.ids import from_hex, random_ids, to_hex

_KEYPOINT_SCALE = 20.0
_MIN_SIGMA_PX = 0.1
"""Standard deviation of perfect keypoints in the map, which an estimator needs as weight."""


def session_map(
    scenario: Scenario, world: World, device: Device, recording: Recording, seeds: SessionSeeds
) -> tuple[VIMap, truth.Truth]:
    """Return a recorded session as a map with drifting states, and its truth.

    Raises:
        UserError: The motion offers too few places for the loop closure edges.
    """
    landmarks = initial_landmarks(device, recording, scenario.measurement.min_track_length)
    vi_map = _assemble(scenario, device, recording, landmarks, seeds)
    vi_map, is_true = add_other_sensors(
        vi_map, device.imu_id, recording, scenario.other_sensors, seeds.other
    )
    return vi_map, truth.session_truth(vi_map, recording, device, world, landmarks.point, is_true)


def _assemble(
    scenario: Scenario,
    device: Device,
    recording: Recording,
    initial: InitialLandmarks,
    seeds: SessionSeeds,
) -> VIMap:
    vertices = len(recording.time_ns)
    sensor_id = np.zeros((1, len(tables.MissionSensor), 2), dtype=np.uint64)
    sensor_id[0, tables.MissionSensor.IMU] = from_hex(device.imu_id)
    sensor_id[0, tables.MissionSensor.NCAMERA] = from_hex(device.rig.id)
    landmarks = tables.Landmarks.filled(
        len(initial.vertex),
        id=random_ids(len(initial.vertex), seeds.ids),
        vertex=initial.vertex,
        p_I=initial.p_I,
    )
    bias_error = seeds.measurement.standard_normal((2, 3))
    edges, samples = _imu_tables(recording, seeds)
    frames, keypoints = _image_tables(scenario, device, recording, initial.of_keypoint, seeds)
    T_G_M = baseframe(scenario.drift, seeds.measurement)
    mission_id, frame_id = random_ids(1, seeds.ids), random_ids(1, seeds.ids)
    return VIMap(
        sensors=device.sensor_set,
        missions=tables.Missions.filled(
            1, id=mission_id, baseframe=[0], root_vertex=[0], sensor_id=sensor_id
        ),
        baseframes=tables.BaseFrames.filled(1, id=frame_id, T_G_M=T_G_M[None]),
        vertices=tables.Vertices.filled(
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


def _imu_tables(
    recording: Recording, seeds: SessionSeeds
) -> tuple[tables.ImuEdges, tables.ImuSamples]:
    """Split the recording at the vertices; neighbouring edges share the boundary sample."""
    row = recording.imu_row
    count = np.diff(row) + 1
    edges = len(count)
    # edge e has the samples row[e] .. row[e + 1], both included
    first = np.repeat(row[:-1] - starts_of_counts(count)[:-1], count)
    rows = first + np.arange(int(count.sum()))
    table = tables.ImuEdges.filled(
        edges,
        id=random_ids(edges, seeds.ids),
        from_vertex=np.arange(edges),
        to_vertex=np.arange(1, edges + 1),
        sample_count=count,
    )
    samples = tables.ImuSamples.filled(
        len(rows),
        timestamp_ns=recording.imu_time_ns[rows],
        accel_gyro=recording.imu.accel_gyro[rows],
    )
    return table, samples


def _image_tables(
    scenario: Scenario,
    device: Device,
    recording: Recording,
    landmark_of: I64,
    seeds: SessionSeeds,
) -> tuple[tables.Frames, tables.Keypoints]:
    detections, cameras = recording.keypoints, len(device.rig.cameras)
    vertices = len(recording.time_ns)
    count = vertices * cameras
    present = (
        tables.FrameField.SIGMA
        | tables.FrameField.SCALE
        | tables.FrameField.TRACK_ID
        | tables.FrameField.LANDMARK_ID
    )
    delays = np.array([camera.line_delay_s for camera in scenario.cameras])
    if delays.any():
        present |= tables.FrameField.TIME_OFFSET
    keypoint_count = np.bincount(detections.frame, minlength=count)
    frames = tables.Frames.filled(
        count,
        id=random_ids(count, seeds.ids),
        vertex=np.repeat(np.arange(vertices), cameras),
        camera_index=np.tile(np.arange(cameras), vertices),
        timestamp_ns=np.repeat(recording.time_ns, cameras),
        keypoint_count=keypoint_count,
        descriptor_blocks=descriptors.binary_blocks(keypoint_count, recording.descriptors.shape[1]),
        present=np.full(count, int(present)),
    )
    factor = scenario.calibration.keypoint_noise_factor
    sigma = np.maximum(
        factor * detection.sigma_of_octave(scenario.measurement, detections.octave), _MIN_SIGMA_PX
    )
    no_offset = np.zeros((len(detections.frame), 0), dtype=np.int32)
    keypoints = tables.Keypoints.filled(
        len(detections.frame),
        uv_px=detections.uv_px,
        sigma_px=sigma,
        scale=_KEYPOINT_SCALE * 2.0**detections.octave,
        time_offset_ns=_readout_ns(scenario, detections) if delays.any() else no_offset,
        track_id=detections.track,
        landmark=landmark_of,
        descriptor=recording.descriptors,
    )
    return frames, keypoints


def _readout_ns(scenario: Scenario, detections: detection.Detections) -> NDArray[np.int32]:
    """Return when (K, 1) keypoints are read out, counted from the image's time stamp."""
    camera = detections.frame % len(scenario.cameras)
    delay_s = np.array([options.line_delay_s for options in scenario.cameras])[camera]
    middle = 0.5 * np.array([options.height_px for options in scenario.cameras])[camera]
    offset = np.round(1e9 * delay_s * (detections.uv_px[:, 1] - middle))
    return np.asarray(offset[:, None], dtype=np.int32)


_MIN_RAY_ANGLE_RAD = np.deg2rad(0.5)
_MAX_LANDMARK_DISTANCE_M = 60.0


@dataclasses.dataclass(frozen=True, eq=False)
class InitialLandmarks:
    """Landmarks of one session, in the order of their tracks."""

    vertex: I64  # (L,) vertex that stores it: the first that sees it
    p_I: F64  # (L, 3) in that vertex' frame
    point: I64  # (L,) the world point that most of its observations show
    of_keypoint: I64  # (K,) landmark of every keypoint, -1 = none


def initial_landmarks(
    device: Device, recording: Recording, min_track_length: int
) -> InitialLandmarks:
    """Triangulate the tracks with the nominal calibration and the estimated poses."""
    detections, cameras = recording.keypoints, len(device.rig.cameras)
    tracked = np.flatnonzero(detections.track >= 0)
    order = tracked[np.argsort(detections.track[tracked], kind="stable")]
    length = np.bincount(detections.track[tracked])
    start = starts_of_counts(length)
    vertex = detections.frame // cameras
    T_M_C, ray_C = _rays(device, recording)
    ray_M = se3.transform(np.concatenate([T_M_C[:, :4], np.zeros((len(T_M_C), 3))], axis=1), ray_C)
    p_M, ok, angle = triangulation.triangulate(T_M_C[order, 4:], ray_M[order], start)
    p_of = np.repeat(p_M, length, axis=0)
    offset = p_of - T_M_C[order, 4:]
    behind = np.sum(offset * ray_M[order], axis=1) <= 0.0
    far = np.linalg.norm(offset, axis=1) > _MAX_LANDMARK_DISTANCE_M
    bad = np.bincount(np.repeat(np.arange(len(length)), length), behind | far, len(length)) > 0
    ok &= (length >= min_track_length) & ~bad
    ok &= angle > _MIN_RAY_ANGLE_RAD
    kept = np.flatnonzero(ok)
    row_of_track = np.full(len(length), -1, dtype=np.int64)
    row_of_track[kept] = np.arange(len(kept))
    landmark_of = np.full(len(detections.track), -1, dtype=np.int64)
    landmark_of[tracked] = row_of_track[detections.track[tracked]]
    first = order[start[kept]]
    T_M_I = recording.states.T_M_I[vertex[first]]
    # the median of a track's points is the point that most of it shows
    middle = start[kept] + length[kept] // 2
    by_point = order[np.lexsort((detections.point[order], detections.track[order]))]
    return InitialLandmarks(
        vertex[first],
        se3.transform(se3.inverse(T_M_I), p_M[kept]),
        detections.point[by_point[middle]],
        landmark_of,
    )


def _rays(device: Device, recording: Recording) -> tuple[F64, F64]:
    """Return the nominal camera pose (N, 7) and the measured ray (N, 3) of every keypoint."""
    detections, cameras = recording.keypoints, device.rig.cameras
    camera_row = detections.frame % len(cameras)
    T_M_I = recording.states.T_M_I[detections.frame // len(cameras)]
    rays = np.empty((len(detections.frame), 3))
    for row, camera in enumerate(cameras):
        of_camera = camera_row == row
        rays[of_camera] = projection.back_project(camera, detections.uv_px[of_camera])[0]
    return se3.compose(T_M_I, device.rig.T_B_C[camera_row]), rays


_SWITCH_VARIANCE = 1e-3


def add_other_sensors(
    vi_map: VIMap,
    imu_id: str,
    recording: Recording,
    options: OtherSensorOptions,
    rng: np.random.Generator,
) -> tuple[VIMap, NDArray[np.bool_]]:
    """Add the measurements of the options to the map of a session.

    Returns:
        The map, and which of its loop closure edges (E,) are true.

    Raises:
        UserError: There is no pair of places for the loop closure edges.
    """
    T_G_I, time_ns = recording.motion.T_G_I, recording.time_ns
    pose_id, odometry_id, wheel_id = random_ids(3, rng)
    T_I_S = se3.make(so3.exp(options.sensor_turn_rad), np.asarray(options.sensor_position_m))
    kinds, edges = tables.MissionSensor, []
    if options.absolute_pose_every_s > 0.0:
        vi_map = with_sensor(vi_map, kinds.ABSOLUTE_6DOF, pose_id, imu_id, T_I_S)
        poses = _absolute_poses(T_G_I, T_I_S, time_ns, pose_id, options, rng)
        vi_map = vi_map.replace(absolute_poses=poses)
    for kind, sensor, edge, is_wanted, T_I_O in (
        (kinds.ODOMETRY_6DOF, odometry_id, TransformationKind.ODOMETRY, options.odometry, T_I_S),
        (
            kinds.WHEEL_ODOMETRY, wheel_id, TransformationKind.WHEEL_ODOMETRY,
            options.wheel_odometry, wheel_mounting(options),
        ),
    ):  # fmt: skip
        if is_wanted:
            vi_map = with_sensor(vi_map, kind, sensor, imu_id, T_I_O)
            edges.append(_odometry(T_G_I, T_I_O, sensor, edge, options, rng))
    if edges:
        vi_map = vi_map.replace(transformation_edges=tables.TransformationEdges.concatenate(edges))
    if options.loop_edges == 0:
        return vi_map, np.zeros(0, dtype=np.bool_)
    loops, is_true = _loop_edges(T_G_I, time_ns, options, rng)
    return vi_map.replace(loop_closure_edges=loops), is_true


def with_sensor(
    vi_map: VIMap, kind: tables.MissionSensor, words: U64, imu_id: str, T_I_S: F64
) -> VIMap:
    """Add a sensor to the map's sensors and its mission."""
    sensor_id, name = to_hex(words), kind.name
    keys = {"id": sensor_id, "sensor_type": name, "topic": name.lower()}
    sensors = SensorSet(
        {**vi_map.sensors.sensors, sensor_id: OtherSensor(sensor_id, name, keys)},
        {**vi_map.sensors.extrinsics, sensor_id: Extrinsics(imu_id, T_I_S)},
        vi_map.sensors.extra,
    )
    ids = np.array(vi_map.missions.sensor_id)
    ids[:, kind] = from_hex(sensor_id)
    return vi_map.replace(sensors=sensors, missions=vi_map.missions.replace(sensor_id=ids))


def _absolute_poses(
    T_G_I: F64,
    T_I_S: F64,
    time_ns: I64,
    sensor: U64,
    options: OtherSensorOptions,
    rng: np.random.Generator,
) -> tables.AbsolutePoses:
    """Measure T_G_S, G being the frame of the simulated world, at vertices."""
    count = int((time_ns[-1] - time_ns[0]) * 1e-9 / options.absolute_pose_every_s) + 1
    wanted = time_ns[0] + np.arange(count) * round(options.absolute_pose_every_s * 1e9)
    vertex = np.unique(np.searchsorted(time_ns, wanted).clip(0, len(time_ns) - 1))
    sigma = _sigma(options.absolute_pose_sigma_m, options.absolute_pose_sigma_deg)
    T_G_S = se3.compose(T_G_I[vertex], T_I_S)
    return tables.AbsolutePoses.filled(
        len(vertex),
        vertex=vertex,
        timestamp_ns=time_ns[vertex],
        sensor_id=np.tile(sensor, (len(vertex), 1)),
        T_G_S=se3.retract(T_G_S, sigma * rng.standard_normal((len(vertex), 6))),
        covariance=np.tile(np.diag(sigma**2), (len(vertex), 1, 1)),
    )


def _odometry(
    T_G_I: F64,
    T_I_S: F64,
    sensor: U64,
    kind: TransformationKind,
    options: OtherSensorOptions,
    rng: np.random.Generator,
) -> tables.TransformationEdges:
    """Measure the motion of the sensor between neighbouring vertices; the error is white."""
    T_G_S = se3.compose(T_G_I, T_I_S)
    T_A_B = se3.relative(T_G_S[:-1], T_G_S[1:])
    count = len(T_A_B)
    sigma = _sigma(options.odometry_sigma_m, options.odometry_sigma_deg)
    if kind == TransformationKind.WHEEL_ODOMETRY:
        T_A_B[:, 4:] *= options.wheel_scale
    return tables.TransformationEdges.filled(
        count,
        id=random_ids(count, rng),
        kind=np.full(count, int(kind)),
        from_vertex=np.arange(count),
        to_vertex=np.arange(1, count + 1),
        T_A_B=se3.retract(T_A_B, sigma * rng.standard_normal((count, 6))),
        covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        sensor_id=np.tile(sensor, (count, 1)),
    )


def _loop_edges(
    T_G_I: F64, time_ns: I64, options: OtherSensorOptions, rng: np.random.Generator
) -> tuple[tables.LoopClosureEdges, NDArray[np.bool_]]:
    """Add edges between places visited twice, and a share of false edges.

    A false edge joins two distant places with the relative pose of two near ones.
    """
    from scipy.spatial.distance import cdist

    gap_ns = round(options.loop_edge_min_gap_s * 1e9)
    distance = cdist(T_G_I[:, 4:], T_G_I[:, 4:])
    apart = time_ns[None] - time_ns[:, None] >= gap_ns
    near = np.argwhere(apart & (distance < options.loop_edge_max_distance_m))
    far = np.argwhere(apart & (distance > 2.0 * options.loop_edge_max_distance_m))
    false_count = round(options.loop_edge_false_share * options.loop_edges)
    if len(near) < options.loop_edges or len(far) < false_count:
        raise UserError(
            f"other_sensors.loop_edges: the motion offers {len(near)} pairs of near and {len(far)} "
            f"of far places; {options.loop_edges} and {false_count} are needed"
        )
    claimed = near[rng.choice(len(near), options.loop_edges, replace=False)]
    joined = claimed.copy()
    joined[:false_count] = far[rng.choice(len(far), false_count, replace=False)]
    order = rng.permutation(options.loop_edges)
    claimed, joined = claimed[order], joined[order]
    sigma = _sigma(options.loop_edge_sigma_m, options.loop_edge_sigma_deg)
    T_A_B = se3.relative(T_G_I[claimed[:, 0]], T_G_I[claimed[:, 1]])
    count = len(joined)
    edges = tables.LoopClosureEdges.filled(
        count,
        id=random_ids(count, rng),
        from_vertex=joined[:, 0],
        to_vertex=joined[:, 1],
        T_A_B=se3.retract(T_A_B, sigma * rng.standard_normal((count, 6))),
        covariance=np.tile(np.diag(sigma**2), (count, 1, 1)),
        switch_variable_variance=np.full(count, _SWITCH_VARIANCE),
    )
    return edges, order >= false_count


def _sigma(metres: float, degrees: float) -> F64:
    return np.repeat([metres, np.deg2rad(degrees)], 3)


_RATE_HZ = 50.0
_HEADER = "#timestamp [ns], vx [m/s], vy [m/s], wz [rad/s]\n"


@dataclasses.dataclass(frozen=True, eq=False)
class WheelVelocities:
    """Wheel measurements: velocity of the sensor S in S, distances times their scale."""

    times_ns: I64  # (N,)
    values: F64  # (N, 3) vx, vy [m/s], wz [rad/s]


def wheel_mounting(options: OtherSensorOptions) -> F64:
    """Return T_I_S (7,) of the wheel sensor."""
    return se3.make(so3.exp(options.wheel_turn_rad), np.asarray(options.wheel_position_m))


def wheel_velocities(
    recording: Recording, options: OtherSensorOptions, rng: np.random.Generator
) -> WheelVelocities:
    """Measure velocities whose integral over the time between two vertices has the stated errors.

    Args:
        options: Mounting, scale, and deviations per edge between vertices.
    """
    stamps = recording.imu_time_ns
    step = max(1, round(1e9 / _RATE_HZ / float(np.median(np.diff(stamps)))))
    motion = recording.imu_motion.take(np.arange(0, len(stamps), step))
    T_I_S = wheel_mounting(options)
    v_I = so3.rotate(so3.inverse(motion.T_G_I[:, :4]), motion.v_G)
    v_I = v_I + np.cross(motion.w_I, T_I_S[4:])
    v_S, w_S = (so3.rotate(so3.inverse(T_I_S[:4]), x) for x in (v_I, motion.w_I))
    values = np.column_stack([options.wheel_scale * v_S[:, :2], w_S[:, 2]])
    row_s = 1e-9 * float(np.median(np.diff(stamps[::step])))
    edge_s = 1e-9 * float(np.median(np.diff(recording.time_ns)))
    sigma = np.array([*[options.odometry_sigma_m] * 2, np.deg2rad(options.odometry_sigma_deg)])
    values += sigma / np.sqrt(row_s * edge_s) * rng.standard_normal(values.shape)
    return WheelVelocities(stamps[::step], values)


def write_wheel_velocities(wheels: WheelVelocities, path: Path, *, overwrite: bool) -> None:
    """Write CSV that `import_wheel_odometry` reads.

    Raises:
        UserError: The file exists and `overwrite` is not set, or cannot be written.
    """
    rows = format_rows("%d,%.9g,%.9g,%.9g", [wheels.times_ns, wheels.values])
    write_text(path, [_HEADER, *rows], overwrite=overwrite)
