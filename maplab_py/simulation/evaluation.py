"""Errors of a map against ground truth: states, missions, landmarks, merges, edges, calibration."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3, yaw
from maplab_py.geometry.alignment import align_yaw_position, umeyama
from maplab_py.report import Report
from maplab_py.sensors import ImuIntrinsics
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import IdIndex, MissionSensor, VIMap, mission_sensor_id, table, to_hex

_FALSE_EDGE_M, _FALSE_EDGE_DEG = 0.5, 5.0


@dataclasses.dataclass(frozen=True)
class MissionError:
    """Errors of one mission."""

    mission: str  # beginning of its id
    vertices: int
    ate_m: float  # RMSE of positions, the mission aligned by itself
    offset_m: float  # position error of the mission relative to the whole map
    yaw_deg: float  # yaw error likewise


class MapErrors(Report):
    """Errors of a map against the truth."""

    missions: tuple[MissionError, ...]
    ate_each_m: float  # RMSE over all vertices, every mission aligned by itself
    ate_m: float  # RMSE over all vertices, all missions aligned together
    scale: float  # of the whole map, 1 = right
    tilt_deg: float  # RMSE of roll and pitch together
    heading_deg: float  # RMSE, all missions aligned together
    velocity_mps: float  # RMSE, in the body frame
    gyro_bias_radps: float  # RMSE
    accel_bias_mps2: float  # RMSE
    landmarks: int  # of which the truth is known, and whose point does not move
    landmark_median_m: float | None  # error of positions; None = there are none
    landmark_90_percent_m: float | None = dataclasses.field(
        metadata={"title": "landmark, 90th percentile", "unit": "m"}
    )
    merges: int  # simulated landmarks that were joined to another one
    false_merges: int  # of these: joined to landmarks of another world point
    missed_merges: int  # landmarks that could still be joined to one of the same world point
    wrong_observations: int  # show another world point than most of their landmark's do
    loop_edges: int
    false_loop_edges: int  # off by more than 0.5 m or 5 deg
    false_loop_edges_trusted: int  # of these: with a switch variable above 0.5
    calibrations: tuple[CalibrationError, ...]


def evaluate_map(vi_map: VIMap, truth: Truth) -> MapErrors:
    """Compare a map with the truth, by id.

    Offset and yaw of a mission: difference between the alignment of the mission with the truth and
    the alignment of the whole map, at the middle of the mission.

    Raises:
        UserError: The truth contains none of the map's vertices.
    """
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    known = np.flatnonzero(row >= 0)
    if len(known) < 3:
        raise UserError("the truth is of another data set: it knows none of the map's vertices")
    row = row[known]
    p_G, p_true = vi_map.T_G_I[known, 4:], truth.T_G_I[row, 4:]
    together, _ = umeyama(p_true, p_G)
    _, scale = umeyama(p_G, p_true, with_scale=True)
    level = align_yaw_position(p_true, p_G)
    missions = _mission_errors(vi_map, known, p_G, p_true, level)
    squares = sum(error.ate_m**2 * error.vertices for error in missions)
    tilt, heading = _attitude(level, vi_map.T_G_I[known], truth.T_G_I[row])
    speed = _in_body(vi_map.vertices.T_M_I[known], vi_map.vertices.v_M[known])
    seen = sightings(vi_map, truth)
    shown = shown_points(seen, len(vi_map.landmarks))
    merged = count_merges(seen, truth, shown)
    distance = _landmark_errors(vi_map, truth, shown, together)
    is_false = _false_loop_edges(vi_map, truth)
    trusted = vi_map.loop_closure_edges.switch_variable > 0.5
    return MapErrors(
        missions=missions,
        ate_each_m=float(np.sqrt(squares / len(known))),
        ate_m=_rmse(p_true, se3.transform(together, p_G)),
        scale=scale,
        tilt_deg=tilt,
        heading_deg=heading,
        velocity_mps=_rmse(speed, _in_body(truth.T_G_I[row], truth.v_G[row])),
        gyro_bias_radps=_rmse(vi_map.vertices.gyro_bias[known], truth.gyro_bias[row]),
        accel_bias_mps2=_rmse(vi_map.vertices.accel_bias[known], truth.accel_bias[row]),
        landmarks=len(distance),
        landmark_median_m=float(np.median(distance)) if len(distance) else None,
        landmark_90_percent_m=float(np.percentile(distance, 90)) if len(distance) else None,
        **dataclasses.asdict(merged),
        loop_edges=len(is_false),
        false_loop_edges=int(np.count_nonzero(is_false)),
        false_loop_edges_trusted=int(np.count_nonzero(is_false & trusted)),
        calibrations=calibration_errors(
            vi_map, truth, IdIndex(truth.mission_id).rows(vi_map.missions.id)
        ),
    )


def _mission_errors(
    vi_map: VIMap, known: I64, p_G: F64, p_true: F64, level: F64
) -> tuple[MissionError, ...]:
    mission = vi_map.vertices.mission[known]
    errors = []
    for number in np.unique(mission):
        rows = mission == number
        ate = _rmse(
            p_true[rows],
            se3.transform(umeyama(p_true[rows], p_G[rows])[0], p_G[rows]),
        )
        offset, angle = _misplacement(level, p_true[rows], p_G[rows])
        name = to_hex(vi_map.missions.id[number])[:8]
        errors.append(MissionError(name, int(rows.sum()), ate, offset, angle))
    return tuple(errors)


def _attitude(T_true_G: F64, T_G_I: F64, T_true_I: F64) -> tuple[float, float]:
    """Return RMSE [deg] of roll and pitch together, and of heading, after levelled alignment."""
    q = so3.multiply(T_true_G[:4], T_G_I[:, :4])
    error = so3.log(so3.multiply(q, so3.inverse(T_true_I[:, :4])))
    tilt = np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
    return float(np.rad2deg(tilt)), float(np.rad2deg(np.sqrt(np.mean(error[:, 2] ** 2))))


def _in_body(T_A_I: F64, v_A: F64) -> F64:
    return so3.rotate(so3.inverse(T_A_I[:, :4]), v_A)


def _landmark_errors(vi_map: VIMap, truth: Truth, shown: I64, T_true_G: F64) -> F64:
    """Return the distances (N,) [m] of landmarks from the points that they show."""
    known = np.flatnonzero(shown >= 0)
    known = known[truth.point_moving[shown[known]] < 0]
    there = se3.transform(T_true_G, vi_map.p_G[known])
    return np.asarray(np.linalg.norm(there - truth.point_G[shown[known]], axis=1))


def _false_loop_edges(vi_map: VIMap, truth: Truth) -> NDArray[np.bool_]:
    """Return which loop closure edges (E,) of the map are wrong."""
    edges, index = vi_map.loop_closure_edges, IdIndex(truth.vertex_id)
    a, b = (
        index.rows(vi_map.vertices.id[vertex]) for vertex in (edges.from_vertex, edges.to_vertex)
    )
    known = (a >= 0) & (b >= 0)
    true = se3.relative(truth.T_G_I[a], truth.T_G_I[b])
    error = se3.local(true, edges.T_A_B)
    far = np.linalg.norm(error[:, :3], axis=1) > _FALSE_EDGE_M
    turned = np.linalg.norm(error[:, 3:], axis=1) > np.deg2rad(_FALSE_EDGE_DEG)
    return np.asarray(known & (far | turned))


def _misplacement(T_true_G: F64, p_true: F64, p_G: F64) -> tuple[float, float]:
    """Return the offset [m] and yaw [deg] of a mission relative to the whole map's alignment."""
    alignment = align_yaw_position(p_true, p_G)
    middle = p_G.mean(axis=0)
    gap = se3.transform(alignment, middle) - se3.transform(T_true_G, middle)
    turn = yaw.wrap(yaw.yaw_of(alignment[:4]) - yaw.yaw_of(T_true_G[:4]))
    return float(np.linalg.norm(gap)), float(abs(np.rad2deg(turn)))


def _rmse(a: F64, b: F64) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


@dataclasses.dataclass(frozen=True)
class CalibrationError:
    """Largest deviations of a mission's sensors from the truth, over its cameras and axes."""

    mission: str  # beginning of its id
    focal_px: float
    centre_px: float
    distortion: float
    camera_rotation_deg: float
    camera_position_m: float
    gyro_scale: float
    gyro_misalignment: float
    accel_scale: float
    accel_misalignment: float
    accel_rotation_deg: float


def calibration_errors(
    vi_map: VIMap, truth: Truth, missions: NDArray[np.int64]
) -> tuple[CalibrationError, ...]:
    """Compare the sensors of every mission with the truth.

    Args:
        missions: Row (M,) of the truth's missions for each mission of the map, -1 = unknown.
    """
    return tuple(
        _of_mission(vi_map, truth, number, row)
        for number, row in enumerate(missions.tolist())
        if row >= 0 and _has_sensors(vi_map, number)
    )


def _has_sensors(vi_map: VIMap, mission: int) -> bool:
    try:
        for sensor in (MissionSensor.IMU, MissionSensor.NCAMERA):
            mission_sensor_id(vi_map, mission, sensor)
    except MapError:
        return False
    return True


def _of_mission(vi_map: VIMap, truth: Truth, mission: int, row: int) -> CalibrationError:
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    imu = vi_map.sensors.imu(imu_id).intrinsics or ImuIntrinsics()
    T_I_C, true_T_I_C = vi_map.sensors.T_I_C(imu_id, rig_id), truth.T_I_C[row]
    deviations = []
    for camera, true in zip(
        vi_map.sensors.camera_rig(rig_id).cameras, truth.camera_parameters[row], strict=True
    ):
        first = len(camera.intrinsics)
        last = first + len(camera.distortion_parameters)
        intrinsics = np.abs(camera.intrinsics - true[:first])
        distortion = np.abs(camera.distortion_parameters - true[first:last])
        deviations.append(
            [intrinsics[-4:-2].max(), intrinsics[-2:].max(), distortion.max(initial=0.0)]
        )
    focal, centre, distortion_error = np.max(deviations, axis=0)
    gyro, accel = imu.T_g - truth.imu_T_g[row], imu.T_a - truth.imu_T_a[row]
    above = np.triu_indices(3, 1)
    return CalibrationError(
        mission=to_hex(vi_map.missions.id[mission])[:8],
        focal_px=float(focal),
        centre_px=float(centre),
        distortion=float(distortion_error),
        camera_rotation_deg=_largest_angle(T_I_C[:, :4], true_T_I_C[:, :4]),
        camera_position_m=float(np.linalg.norm(T_I_C[:, 4:] - true_T_I_C[:, 4:], axis=1).max()),
        gyro_scale=float(np.abs(np.diag(gyro)).max()),
        gyro_misalignment=float(np.abs(gyro[above]).max()),
        accel_scale=float(np.abs(np.diag(accel)).max()),
        accel_misalignment=float(np.abs(accel[above]).max()),
        accel_rotation_deg=_largest_angle(
            so3.from_matrix(imu.R_A_I)[None], so3.from_matrix(truth.imu_R_A_I[row])[None]
        ),
    )


def _largest_angle(q: F64, q_true: F64) -> float:
    turn = so3.log(so3.multiply(so3.inverse(q_true), q))
    return float(np.rad2deg(np.linalg.norm(turn, axis=1).max()))


@dataclasses.dataclass(frozen=True, eq=False)
class Sightings:
    """Observations (O,) of the map whose world point the truth contains."""

    landmark: I64  # row in the map
    point: I64  # world point, -1 = nothing (clutter)
    track: I64  # landmark of the truth that the keypoint belonged to at first, -1 = none


@dataclasses.dataclass(frozen=True)
class MergeCounts:
    """Counts of simulated landmarks (tracks) that were merged or should be."""

    merges: int  # tracks that were joined to another one
    false_merges: int  # of these: joined to tracks of another world point
    missed_merges: int  # landmarks that could still be joined to one of the same world point
    wrong_observations: int  # show another world point than most of their landmark's do


def sightings(vi_map: VIMap, truth: Truth) -> Sightings:
    """Look up the world points of the observations of a map.

    Frames whose number of keypoints has changed are skipped.
    """
    row = IdIndex(truth.frame_id).rows(vi_map.frames.id)
    usable = row >= 0
    usable[usable] = truth.frame_keypoints[row[usable]] == vi_map.frames.keypoint_count[usable]
    start = table.starts_of_counts(truth.frame_keypoints)
    of_truth = table.ragged_rows(start, row[usable])
    of_map = table.ragged_rows(vi_map.keypoint_start, np.flatnonzero(usable))
    landmark = vi_map.keypoints.landmark[of_map].astype(np.int64)
    observing = landmark >= 0
    rows = of_truth[observing]
    return Sightings(landmark[observing], truth.keypoint_point[rows], truth.keypoint_landmark[rows])


def shown_points(seen: Sightings, landmarks: int) -> I64:
    """Return the world point (L,) that most observations of each landmark show, -1 = none.

    Ties are resolved by the lowest row.
    """
    real = seen.point >= 0
    pairs, votes = np.unique(
        np.stack([seen.landmark[real], seen.point[real]], axis=1), axis=0, return_counts=True
    )
    order = np.lexsort((pairs[:, 1], -votes, pairs[:, 0]))
    owner, first = np.unique(pairs[order, 0], return_index=True)
    result = np.full(landmarks, -1, dtype=np.int64)
    result[owner] = pairs[order[first], 1]
    return result


def count_merges(seen: Sightings, truth: Truth, point_of_landmark: I64) -> MergeCounts:
    """Count merges against the truth.

    Args:
        seen: The map's observations.
        point_of_landmark: World point (L,) of the map's landmarks, see `shown_points`.
    """
    known = seen.track >= 0
    pairs = np.unique(np.stack([seen.landmark[known], seen.track[known]], axis=1), axis=0)
    landmark, point_of_track = pairs[:, 0], truth.landmark_point[pairs[:, 1]]
    merges = len(pairs) - len(distinct(landmark))
    # of one landmark's tracks those of the most frequent point are right together
    groups, size = np.unique(
        np.stack([landmark, point_of_track], axis=1), axis=0, return_counts=True
    )
    most = np.zeros(len(point_of_landmark), dtype=np.int64)
    np.maximum.at(most, groups[:, 0], size)
    false_merges = len(pairs) - int(most.sum())
    shown = point_of_landmark[distinct(seen.landmark)]
    shown = shown[shown >= 0]
    wrong = (seen.point >= 0) & (seen.point != point_of_landmark[seen.landmark])
    return MergeCounts(
        merges,
        false_merges,
        len(shown) - len(distinct(shown)),
        int(np.count_nonzero(wrong)),
    )
