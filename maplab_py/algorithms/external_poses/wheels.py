"""Wheel odometry as edges between neighbouring vertices of a mission."""

from pathlib import Path

import numpy as np

from maplab_py.algorithms.external_poses import trajectories
from maplab_py.algorithms.external_poses.options import WheelImport, WheelOptions
from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.wheel_odometry import WheelTrack
from maplab_py.sensors import OtherSensor, yaml_entry
from maplab_py.sensors.wheels import WHEEL_ODOMETRY, wheel_scale
from maplab_py.vimap import (
    MissionSensor,
    TransformationKind,
    VIMap,
    mission_labels,
    mission_sensor_id,
    tables,
)
from maplab_py.vimap.ids import from_hex, random_ids, to_hex

_COVARIANCE = "T_St_Stp1_fixed_covariance"
"""Key of maplab: the covariance (6 x 6), position first, of every edge of the sensor."""
_STANDSTILL_M, _TURNING_ARM_M = 0.01, 0.25
"""Addition of standing still, and of a turn by one radian, to the distance that uncertainty grows with."""
_MIN_DISTANCE_M, _MIN_TURN_RAD = 1.0, 0.5
_MAX_DISTANCE_RATIO, _MAX_TURN_RATIO = 2.0, 5.0
"""Wheels that differ more from what the map says have other units, or are those of another mission."""


def attach_wheels(
    vi_map: VIMap, mission: int, track: WheelTrack, options: WheelOptions
) -> tuple[VIMap, WheelImport]:
    """Join neighbouring vertices of a mission (row) by wheel odometry edges.

    Edges relate the frames of the wheel sensor at two vertices; its poses are interpolated to their times.

    Raises:
        UserError: Nothing is at the time of the mission; the mission has wheel edges and `options.replace`
            is not set; distances or turns are far from those of the map; the map has no such sensor.
    """
    given = _given_sensor(vi_map, options.sensor_id)
    vi_map = trajectories.without_edges(
        vi_map,
        mission,
        TransformationKind.WHEEL_ODOMETRY,
        track.source,
        replace=options.replace,
        flag="wheel_replace",
        keep=options.sensor_id,
    )
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    if len(rows) < 2:
        raise UserError(f"{track.source}: the mission has fewer than two vertices to join")
    stamps = vi_map.vertices.timestamp_ns[rows]
    times_ns = track.times_ns + round(options.time_offset_s * 1e9)
    gap_ns = round(options.max_gap_s * 1e9)
    T_O_S, covered = interpolate_poses(times_ns, track.T_O_S, stamps, max_gap_ns=gap_ns)
    first = np.flatnonzero(covered[:-1] & covered[1:])
    if not len(first):
        raise _no_overlap(track, times_ns, stamps)
    if given is None:
        words, covariance = (
            trajectories.content_words(vi_map, mission, "wheels", times_ns, T_O_S),
            None,
        )
        keys = {"topic": "", "description": "wheel odometry of another program"}
        kind = MissionSensor.WHEEL_ODOMETRY
        vi_map = trajectories.with_sensor(vi_map, mission, kind, words, options.T_I_S, keys)
    else:
        vi_map, words, covariance = _with_given_sensor(vi_map, mission, given)
    T_A_B = se3.relative(T_O_S[first], T_O_S[first + 1])
    ratio = _compared(vi_map, mission, to_hex(words), rows[first], T_A_B, track.source)
    if covariance is None:
        covariance = _covariances(T_A_B, options, is_planar=track.is_planar)
    seed = trajectories.content_words(vi_map, mission, "wheel edges", times_ns, T_O_S)
    count, rng = len(first), np.random.default_rng(seed)
    edges = tables.TransformationEdges.filled(
        count,
        id=random_ids(count, rng),
        kind=np.full(count, int(TransformationKind.WHEEL_ODOMETRY)),
        from_vertex=rows[first],
        to_vertex=rows[first] + 1,
        T_A_B=T_A_B,
        covariance=np.broadcast_to(covariance, (count, 6, 6)),
        sensor_id=np.tile(words, (count, 1)),
    )
    table = tables.TransformationEdges.concatenate([vi_map.transformation_edges, edges])
    return vi_map.replace(transformation_edges=table), WheelImport(
        file=Path(track.source),
        kind=track.kind,
        mission=mission_labels(vi_map)[mission],
        sensor_id=to_hex(words),
        rows_in_file=len(track),
        added=count,
        without_edge=len(rows) - 1 - count,
        distance_ratio=ratio,
    )


def _given_sensor(vi_map: VIMap, sensor_id: str) -> OtherSensor | None:
    """Return the wheel sensor of the map with an id; None for an empty id.

    Raises:
        UserError: There is none.
    """
    if not sensor_id:
        return None
    sensor = vi_map.sensors.sensors.get(sensor_id)
    if isinstance(sensor, OtherSensor) and sensor.sensor_type == WHEEL_ODOMETRY:
        return sensor
    raise UserError(
        f"--wheel_sensor_id={sensor_id}: sensors.yaml has no {WHEEL_ODOMETRY} sensor of this id: leave the "
        "flag out and give the mounting with --wheel_position_m and --wheel_orientation_xyzw"
    )


def _with_given_sensor(
    vi_map: VIMap, mission: int, sensor: OtherSensor
) -> tuple[VIMap, U64, F64 | None]:
    """Return the map whose mission has a sensor, its id (2,) and the covariance (6, 6) of its entry.

    Raises:
        MapError: The covariance in sensors.yaml is no matrix.
    """
    words = from_hex(sensor.id)
    missions = vi_map.missions.put((mission, MissionSensor.WHEEL_ODOMETRY), sensor_id=words)
    entry = yaml_entry.Entry(sensor.keys, f"sensors.yaml: sensor {sensor.id}")
    covariance = entry.matrix(_COVARIANCE, 6, 6) if _COVARIANCE in entry else None
    return vi_map.replace(missions=missions), words, covariance


def _covariances(T_A_B: F64, options: WheelOptions, *, is_planar: bool) -> F64:
    """Return covariances (E, 6, 6), position first, that grow with the distance of every edge."""
    turn_rad = np.linalg.norm(so3.log(T_A_B[:, :4]), axis=1)
    distance_m = np.linalg.norm(T_A_B[:, 4:], axis=1) + _TURNING_ARM_M * turn_rad + _STANDSTILL_M
    yaw = np.deg2rad(options.yaw_sigma_deg)
    height, tilt = options.position_sigma_m, yaw
    if is_planar:
        height, tilt = options.vertical_sigma_m, np.deg2rad(options.tilt_sigma_deg)
    sigma = np.array([options.position_sigma_m, options.position_sigma_m, height, tilt, tilt, yaw])
    return np.asarray(distance_m[:, None, None] * np.diag(sigma**2))


def _compared(
    vi_map: VIMap, mission: int, sensor_id: str, first: I64, T_A_B: F64, source: str
) -> float:
    """Return distance of the wheels / distance of the map; NaN where nothing moves.

    Raises:
        UserError: Distances or turns differ by far more than slip explains.
    """
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    T_I_S = vi_map.sensors.T_I_S(imu_id, sensor_id)
    T_M_S = [se3.compose(vi_map.vertices.T_M_I[rows], T_I_S) for rows in (first, first + 1)]
    in_map = se3.relative(*T_M_S)
    metres = [float(np.linalg.norm(T[:, 4:], axis=1).sum()) for T in (T_A_B, in_map)]
    radians = [float(np.abs(so3.log(T[:, :4])[:, 2]).sum()) for T in (T_A_B, in_map)]
    metres[0] /= wheel_scale(vi_map.sensors, sensor_id)
    for (wheels, of_map), least, limit, unit in (
        (metres, _MIN_DISTANCE_M, _MAX_DISTANCE_RATIO, "m"),
        (radians, _MIN_TURN_RAD, _MAX_TURN_RATIO, "rad"),
    ):
        if of_map > least and not of_map / limit < wheels < of_map * limit:
            raise UserError(
                f"{source}: the wheels moved {wheels:.4g} {unit}, the mission {of_map:.4g} {unit} in that "
                "time: metres, radians and s or ns are wanted, and the time and mounting of this mission"
            )
    return metres[0] / metres[1] if metres[1] > _MIN_DISTANCE_M else float("nan")


def _no_overlap(track: WheelTrack, times_ns: I64, stamps: I64) -> UserError:
    spans = [f"{t[0] * 1e-9:.3f} to {t[-1] * 1e-9:.3f} s" for t in (times_ns, stamps)]
    return UserError(
        f"{track.source}: has wheel odometry from {spans[0]}, the mission vertices from {spans[1]}: give "
        "--wheel_time_offset_s, or a larger --wheel_max_gap_s"
    )
