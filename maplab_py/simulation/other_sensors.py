"""Simulate absolute poses, odometry, wheel odometry and loop closure edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64, I64, U64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Extrinsics, OtherSensor, SensorSet
from maplab_py.simulation.recording import Recording
from maplab_py.simulation.scenario import OtherSensorOptions
from maplab_py.simulation.wheels import wheel_mounting
from maplab_py.vimap import MissionSensor, TransformationKind, VIMap
from maplab_py.vimap.ids import from_hex, random_ids, to_hex
from maplab_py.vimap.tables import AbsolutePoses, LoopClosureEdges, TransformationEdges

_SWITCH_VARIANCE = 1e-3
_SENSOR_NAMES = {
    MissionSensor.ABSOLUTE_6DOF: "ABSOLUTE_6DOF",
    MissionSensor.ODOMETRY_6DOF: "ODOMETRY_6DOF",
    MissionSensor.WHEEL_ODOMETRY: "WHEEL_ODOMETRY",
}


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
    wanted = {
        MissionSensor.ABSOLUTE_6DOF: options.absolute_pose_every_s > 0.0,
        MissionSensor.ODOMETRY_6DOF: options.odometry,
        MissionSensor.WHEEL_ODOMETRY: options.wheel_odometry,
    }
    ids = dict(zip(wanted, random_ids(len(wanted), rng), strict=True))
    T_I_S = se3.make(so3.exp(options.sensor_turn_rad), np.asarray(options.sensor_position_m))
    edges = []
    for kind in (MissionSensor.ABSOLUTE_6DOF, MissionSensor.ODOMETRY_6DOF):
        if wanted[kind]:
            vi_map = _with_sensor(vi_map, kind, ids[kind], imu_id, T_I_S)
    if wanted[MissionSensor.ABSOLUTE_6DOF]:
        poses = _absolute_poses(
            T_G_I, T_I_S, time_ns, ids[MissionSensor.ABSOLUTE_6DOF], options, rng
        )
        vi_map = vi_map.replace(absolute_poses=poses)
    if wanted[MissionSensor.ODOMETRY_6DOF]:
        sensor = ids[MissionSensor.ODOMETRY_6DOF]
        edges.append(_odometry(T_G_I, T_I_S, sensor, TransformationKind.ODOMETRY, options, rng))
    if wanted[MissionSensor.WHEEL_ODOMETRY]:
        kind, sensor = MissionSensor.WHEEL_ODOMETRY, ids[MissionSensor.WHEEL_ODOMETRY]
        T_I_W = wheel_mounting(options)
        vi_map = _with_sensor(vi_map, kind, sensor, imu_id, T_I_W)
        wheel = TransformationKind.WHEEL_ODOMETRY
        edges.append(_odometry(T_G_I, T_I_W, sensor, wheel, options, rng))
    if edges:
        vi_map = vi_map.replace(transformation_edges=TransformationEdges.concatenate(edges))
    if options.loop_edges == 0:
        return vi_map, np.zeros(0, dtype=np.bool_)
    loops, is_true = _loop_edges(T_G_I, time_ns, options, rng)
    return vi_map.replace(loop_closure_edges=loops), is_true


def _with_sensor(vi_map: VIMap, kind: MissionSensor, words: U64, imu_id: str, T_I_S: F64) -> VIMap:
    """Add a sensor to the map's sensors and its mission."""
    sensor_id, name = to_hex(words), _SENSOR_NAMES[kind]
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
) -> AbsolutePoses:
    """Measure T_G_S, G being the frame of the simulated world, at vertices."""
    count = int((time_ns[-1] - time_ns[0]) * 1e-9 / options.absolute_pose_every_s) + 1
    wanted = time_ns[0] + np.arange(count) * round(options.absolute_pose_every_s * 1e9)
    vertex = np.unique(np.searchsorted(time_ns, wanted).clip(0, len(time_ns) - 1))
    sigma = _sigma(options.absolute_pose_sigma_m, options.absolute_pose_sigma_deg)
    T_G_S = se3.compose(T_G_I[vertex], T_I_S)
    return AbsolutePoses.filled(
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
) -> TransformationEdges:
    """Measure the motion of the sensor between neighbouring vertices; the error is white."""
    T_G_S = se3.compose(T_G_I, T_I_S)
    T_A_B = se3.relative(T_G_S[:-1], T_G_S[1:])
    count = len(T_A_B)
    sigma = _sigma(options.odometry_sigma_m, options.odometry_sigma_deg)
    if kind == TransformationKind.WHEEL_ODOMETRY:
        T_A_B[:, 4:] *= options.wheel_scale
    return TransformationEdges.filled(
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
) -> tuple[LoopClosureEdges, NDArray[np.bool_]]:
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
    edges = LoopClosureEdges.filled(
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
