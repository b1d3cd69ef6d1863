"""Trajectories of other programs as absolute poses, odometry edges, or missions."""

import dataclasses
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.evaluation import plausibility, trajectory_evaluation
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.external_poses import alignment
from maplab_py.algorithms.external_poses.options import TrajectoryImport, TrajectoryOptions
from maplab_py.array_types import F64, I64, U64, Mask, mask_of
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.geometry import se3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors import Extrinsics, OtherSensor
from maplab_py.vimap import (
    MissionSensor,
    TransformationKind,
    VIMap,
    mission_labels,
    mission_sensor_id,
    tables,
)
from maplab_py.vimap.ids import from_hex, random_ids, to_hex

_ALONG = "odometry of a trajectory"
_MOTION_DEG = 20.0
"""Difference of rotations that is noted; drift stays below."""


def shifted(trajectory: Trajectory, time_offset_s: float) -> Trajectory:
    """Return a trajectory with another clock."""
    return dataclasses.replace(
        trajectory, times_ns=trajectory.times_ns + round(time_offset_s * 1e9)
    )


def as_absolute_poses(
    vi_map: VIMap, mission: int, trajectory: Trajectory, options: TrajectoryOptions
) -> tuple[VIMap, TrajectoryImport]:
    """Attach poses T_G_S to the vertices of a mission (row) that are nearest to them.

    A pose is interpolated to the time of its vertex.

    Raises:
        UserError: Nothing of the trajectory is at the time of the mission, or the mission has absolute
            poses and `options.replace` is not set.
        EstimationError: The vertical of the trajectory is not that of the mission, or another order of the
            quaternions fits clearly better.
    """
    before = vi_map
    vi_map = without_absolute_poses(vi_map, mission, trajectory.source, replace=options.replace)
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    stamps = vi_map.vertices.timestamp_ns[rows]
    T_G_S, covered = _at(trajectory, stamps, options)
    chosen = mask_of(len(rows), nearest(stamps, trajectory.times_ns))
    chosen &= covered
    if not chosen.any():
        raise _no_overlap(vi_map, rows, trajectory, options)
    missing = int(np.count_nonzero(~chosen))
    rows, T_G_S = rows[chosen], T_G_S[chosen]
    T_I_S = mounting(vi_map, mission, options.sensor_id)
    words = content_words(vi_map, mission, "absolute", trajectory.times_ns, trajectory.T_R_B)
    keys = {"topic": "", "description": "trajectory of another program"}
    vi_map = with_sensor(vi_map, mission, MissionSensor.ABSOLUTE_6DOF, words, T_I_S, keys)
    T_M_S = se3.compose(vi_map.vertices.T_M_I[rows], T_I_S)
    movement, T_G_M, sigma = alignment.Movement(0.0, 0.0), vi_map.T_G_M[mission], _sigma(options)
    if len(rows) > 1:
        T_G_M = alignment.robust_yaw_position(T_G_S[:, 4:], T_M_S[:, 4:])
    T_G_S_map = se3.compose(T_G_M, T_M_S)
    if trajectory.has_orientation:
        hint = plausibility.orientation_hint(T_G_S[:, :4], T_G_S_map[:, :4], is_mounted=True)
        if hint and not clock_note(vi_map, mission, trajectory, options):
            raise EstimationError(f"{trajectory.source}: {hint}")
        alignment.check_vertical(T_G_S[:, :4], T_M_S[:, :4], trajectory.source)
    else:  # the estimated orientation, which weighs nothing
        T_G_S, sigma[3:] = se3.make(T_G_S_map[:, :4], T_G_S[:, 4:]), UNKNOWN_SIGMA_RAD
    if options.align and len(rows) > 1:
        vi_map, movement = alignment.with_aligned_base_frame(vi_map, mission, T_G_M)
    added = tables.AbsolutePoses.filled(
        len(rows),
        vertex=rows,
        timestamp_ns=vi_map.vertices.timestamp_ns[rows],
        sensor_id=np.tile(words, (len(rows), 1)),
        T_G_S=T_G_S,
        covariance=np.tile(np.diag(sigma**2), (len(rows), 1, 1)),
    )
    table = tables.AbsolutePoses.concatenate([vi_map.absolute_poses, added])
    report = _report(before, mission, trajectory, options, (len(rows), missing), [])
    return vi_map.replace(absolute_poses=table), dataclasses.replace(report, **movement._asdict())


def _report(
    vi_map: VIMap,
    mission: int,
    trajectory: Trajectory,
    options: TrajectoryOptions,
    counts: tuple[int, int],
    notes: list[str],
) -> TrajectoryImport:
    """Return the report on measurements, given how many were added, and vertices or pairs without."""
    clock = clock_note(vi_map, mission, trajectory, options)
    return TrajectoryImport(
        file=Path(trajectory.source),
        kind=options.kind,
        mission=mission_labels(vi_map)[mission],
        poses_in_file=len(trajectory),
        added=counts[0],
        without_pose=counts[1],
        notes=tuple(note for note in (*notes, clock) if note),
    )


def as_odometry(
    vi_map: VIMap, mission: int, trajectory: Trajectory, options: TrajectoryOptions
) -> tuple[VIMap, TrajectoryImport]:
    """Join neighbouring vertices of a mission (row) by the motion of a trajectory.

    Raises:
        UserError: Nothing of the trajectory is at the time of the mission, the mission has odometry edges
            and `options.replace` is not set, or the trajectory has positions only.
        EstimationError: Another order of the quaternions fits clearly better.
    """
    _check_orientation(trajectory)
    before, kind = vi_map, TransformationKind.ODOMETRY
    vi_map = without_edges(vi_map, mission, kind, trajectory.source, replace=options.replace)
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    stamps = vi_map.vertices.timestamp_ns[rows]
    T_R_S, covered = _at(trajectory, stamps, options)
    first = np.flatnonzero(covered[:-1] & covered[1:])
    if not len(first):
        raise _no_overlap(vi_map, rows, trajectory, options)
    words = content_words(vi_map, mission, "odometry", trajectory.times_ns, trajectory.T_R_B)
    T_I_S = mounting(vi_map, mission, options.sensor_id)
    q_M_S = se3.compose(vi_map.vertices.T_M_I[rows[covered]], T_I_S)[:, :4]
    apart_deg, hint = plausibility.motion_hint(T_R_S[covered, :4], q_M_S)
    if hint and not clock_note(vi_map, mission, trajectory, options):
        raise EstimationError(f"{trajectory.source}: {hint}")
    notes = []
    if apart_deg > _MOTION_DEG:
        notes.append(
            f"its rotations differ from those of the mission by {apart_deg:.0f} deg (median over a quarter "
            "of the path): name the sensor with --sensor_id"
        )
    keys = {"topic": "", "description": "trajectory of another program"}
    vi_map = with_sensor(vi_map, mission, MissionSensor.ODOMETRY_6DOF, words, T_I_S, keys)
    edges = _edges(rows[first], stamps, first, T_R_S, words, options)
    table = tables.TransformationEdges.concatenate([vi_map.transformation_edges, edges])
    counts = len(first), len(rows) - 1 - len(first)
    report = _report(before, mission, trajectory, options, counts, notes)
    return vi_map.replace(transformation_edges=table), report


def as_mission(trajectory: Trajectory, options: TrajectoryOptions) -> VIMap:
    """Return a map of one mission: a vertex per pose, joined by odometry edges.

    The frame of the trajectory becomes the mission's; velocities are those of the file, or of the motion.

    Raises:
        UserError: There are fewer than two poses, or positions only.
    """
    _check_orientation(trajectory)
    count = len(trajectory)
    if count < 2:
        raise UserError(f"{trajectory.source}: a mission needs two poses, and there is {count}")
    times = trajectory.times_ns
    words = content_words(_NO_MISSION, 0, _ALONG, times, trajectory.T_R_B)
    rng = np.random.default_rng(words)
    missions = tables.Missions.filled(
        1,
        id=random_ids(1, rng),
        baseframe=[0],
        root_vertex=[0],
        backbone=[tables.Backbone.ODOMETRY],
    )
    zeros = np.zeros((count, 3))
    biases = (trajectory.gyro_bias, trajectory.accel_bias)
    gyro_bias, accel_bias = (zeros if bias is None else bias for bias in biases)
    p, seconds = trajectory.T_R_B[:, 4:], (times - times[0]) * 1e-9
    v_M = np.gradient(p, seconds, axis=0) if trajectory.v_R is None else trajectory.v_R
    vi_map = VIMap(
        missions=missions,
        baseframes=tables.BaseFrames.filled(1, id=random_ids(1, rng)),
        vertices=tables.Vertices.filled(
            count,
            id=random_ids(count, rng),
            mission=np.zeros(count, dtype=np.int32),
            T_M_I=trajectory.T_R_B,
            v_M=v_M,
            gyro_bias=gyro_bias,
            accel_bias=accel_bias,
            timestamp_ns=times,
        ),
    )
    keys = {"topic": "", "description": "trajectory of another program"}
    vi_map = with_sensor(vi_map, 0, MissionSensor.ODOMETRY_6DOF, words, se3.identity(), keys)
    first = np.arange(count - 1)
    edges = _edges(first, times, first, trajectory.T_R_B, words, options)
    return vi_map.replace(transformation_edges=edges)


def clock_note(
    vi_map: VIMap, mission: int, trajectory: Trajectory, options: TrajectoryOptions
) -> str:
    """Return a clause on the offset that makes a shifted trajectory fit a mission (row) much better."""
    rows = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    as_read = shifted(trajectory, -options.time_offset_s)
    evaluation = TrajectoryEvaluationOptions(time_offset_s=options.time_offset_s)
    return trajectory_evaluation.clock_hint(vi_map, rows, as_read, evaluation)


def nearest(stamps: I64, times: I64) -> I64:
    """Return the index (N,) of the stamp (V,) that is nearest to each time (N,)."""
    after = np.clip(np.searchsorted(stamps, times), 1, max(len(stamps) - 1, 1))
    is_before = times - stamps[after - 1] <= stamps[np.minimum(after, len(stamps) - 1)] - times
    return np.asarray(np.where(is_before, after - 1, np.minimum(after, len(stamps) - 1)))


_NO_MISSION = VIMap(missions=tables.Missions.filled(1))


def _at(trajectory: Trajectory, stamps: I64, options: TrajectoryOptions) -> tuple[F64, Mask]:
    gap_ns = round(options.max_gap_s * 1e9)
    return interpolate_poses(trajectory.times_ns, trajectory.T_R_B, stamps, max_gap_ns=gap_ns)


def _edges(
    from_vertex: I64,
    stamps: I64,
    first: I64,
    T_R_S: F64,
    words: U64,
    options: TrajectoryOptions,
) -> tables.TransformationEdges:
    """Return edges from poses `first` to the next; variances grow with time."""
    count, rng = len(first), np.random.default_rng(words)
    seconds = (stamps[first + 1] - stamps[first]) * 1e-9
    return tables.TransformationEdges.filled(
        count,
        id=random_ids(count, rng),
        kind=np.full(count, int(TransformationKind.ODOMETRY)),
        from_vertex=from_vertex,
        to_vertex=from_vertex + 1,
        T_A_B=se3.relative(T_R_S[first], T_R_S[first + 1]),
        covariance=seconds[:, None, None] * np.diag(_sigma(options) ** 2),
        sensor_id=np.tile(words, (count, 1)),
    )


def _sigma(options: TrajectoryOptions) -> F64:
    return np.repeat([options.position_sigma_m, np.deg2rad(options.orientation_sigma_deg)], 3)


def without_absolute_poses(
    vi_map: VIMap, mission: int, source: str, *, replace: bool, flag: str = "replace"
) -> VIMap:
    """Remove the absolute poses of a mission (row) and the sensors that nothing else needs.

    Raises:
        UserError: There are some, and `replace` is not set.
    """
    table = vi_map.absolute_poses
    of_mission = vi_map.vertices.mission[table.vertex] == mission
    if of_mission.any() and not replace:
        raise UserError(
            f"{source}: the mission has {np.count_nonzero(of_mission)} absolute poses already: give --{flag} "
            "to remove them first"
        )
    kept = vi_map.replace(absolute_poses=table.take(~of_mission))
    return _without_unused(
        kept, mission, table.sensor_id[of_mission], kept.absolute_poses.sensor_id
    )


def without_edges(
    vi_map: VIMap,
    mission: int,
    kind: TransformationKind,
    source: str,
    *,
    replace: bool,
    flag: str = "replace",
    keep: str = "",
) -> VIMap:
    """Remove the edges of a kind of a mission (row) and the sensors that nothing else needs.

    Args:
        mission: Row of the mission.
        kind: Kind of the edges.
        source: Name of the file that has others.
        replace: Whether edges may be removed.
        flag: Flag that allows it.
        keep: Id of a sensor that stays.

    Raises:
        UserError: There are some, and `replace` is not set.
    """
    table = vi_map.transformation_edges
    of_mission = (vi_map.vertices.mission[table.from_vertex] == mission) & (table.kind == kind)
    if of_mission.any() and not replace:
        name = kind.name.lower().replace("_", " ")
        raise UserError(
            f"{source}: the mission has {np.count_nonzero(of_mission)} {name} edges already: give --{flag} "
            "to remove them first"
        )
    kept = vi_map.replace(transformation_edges=table.take(~of_mission))
    measured = kept.transformation_edges.sensor_id
    removed = table.sensor_id[of_mission]
    if keep:
        removed = removed[~np.all(removed == from_hex(keep), axis=1)]
    return _without_unused(kept, mission, removed, measured)


def _without_unused(vi_map: VIMap, mission: int, removed: U64, measured: U64) -> VIMap:
    """Remove those of some sensors (N, 2) without measurements that nothing else needs.

    Other missions may have them, and other sensors may be mounted on them.
    """
    mounts = vi_map.sensors.extrinsics.items()
    bases = {mount.base_sensor_id for sensor, mount in mounts if mount.base_sensor_id != sensor}
    others = np.delete(vi_map.missions.sensor_id, mission, axis=0).reshape(-1, 2)
    used = set(map(tuple, np.concatenate([measured, others]).tolist()))
    words = [row for row in np.unique(removed, axis=0).tolist() if any(row)]
    unused = [
        row
        for row in words
        if tuple(row) not in used and to_hex(np.array(row, dtype=np.uint64)) not in bases
    ]
    return without_sensors(vi_map, np.array(unused, dtype=np.uint64).reshape(-1, 2))


def _check_orientation(trajectory: Trajectory) -> None:
    if not trajectory.has_orientation:
        raise UserError(f"{trajectory.source}: has positions only: --as=absolute uses them")


def _no_overlap(
    vi_map: VIMap, rows: I64, trajectory: Trajectory, options: TrajectoryOptions
) -> UserError:
    stamps = vi_map.vertices.timestamp_ns[rows]
    spans = [
        f"{times[0] * 1e-9:.3f} to {times[-1] * 1e-9:.3f} s" if len(times) else "nothing"
        for times in (trajectory.times_ns, stamps)
    ]
    hint = (
        clock_note(vi_map, int(vi_map.vertices.mission[rows[0]]), trajectory, options)
        if len(rows)
        else ""
    )
    remedy = hint or "give --time_offset_s, or a larger --max_gap_s"
    return UserError(
        f"{trajectory.source}: has poses from {spans[0]}, the mission vertices from {spans[1]}: {remedy}"
    )


UNKNOWN_SIGMA_RAD = 1e3
"""Deviation of orientations that were not measured: they weigh nothing."""


def content_words(vi_map: VIMap, mission: int, kind: str, times_ns: I64, values: F64) -> U64:
    """Return an id (2,) that follows from measurements and the mission that gets them.

    Six decimals of the values count: their last digits differ between processors.
    """
    content = hashlib.blake2b(kind.encode(), digest_size=16)
    content.update(vi_map.missions.id[mission].tobytes())
    content.update(np.ascontiguousarray(times_ns).tobytes())
    content.update(np.ascontiguousarray(values.round(6) + 0.0).tobytes())  # + 0: no negative zero
    rng = np.random.default_rng(int.from_bytes(content.digest(), "little"))
    return np.asarray(random_ids(1, rng)[0], dtype=np.uint64)


def with_sensor(
    vi_map: VIMap,
    mission: int,
    kind: MissionSensor,
    words: U64,
    T_I_S: F64,
    keys: Mapping[str, Any],
) -> VIMap:
    """Return the map with a sensor on the body of a mission (row).

    Raises:
        UserError: The map has a sensor of this id, that is, these measurements already, or there is nothing
            to mount the sensor on.
    """
    sensor_id, name = to_hex(words), kind.name
    if sensor_id in vi_map.sensors.sensors:
        raise UserError(f"the map has these measurements already, of sensor {sensor_id}")
    entry = {"id": sensor_id, "sensor_type": name, **keys}
    sensors = vi_map.sensors
    base = _base(vi_map, mission)
    is_off_body = bool(np.any(T_I_S[:4] != [0.0, 0.0, 0.0, 1.0]) or np.any(T_I_S[4:] != 0.0))
    if not base and is_off_body:
        raise UserError(
            "the mission has neither IMU nor odometry nor cameras to mount a sensor on: leave out its lever "
            "arm"
        )
    T_B_S = se3.relative(sensors.T_R_S(base), T_I_S) if base else se3.identity()
    if base and base == mission_sensor_id(vi_map, mission, MissionSensor.IMU):
        T_B_S = np.asarray(T_I_S)
    mounts = {**sensors.extrinsics, sensor_id: Extrinsics(base or sensor_id, T_B_S)}
    return vi_map.replace(
        sensors=type(sensors)(
            {**sensors.sensors, sensor_id: OtherSensor(sensor_id, name, entry)},
            mounts,
            sensors.extra,
        ),
        missions=vi_map.missions.put((mission, kind), sensor_id=from_hex(sensor_id)),
    )


def _base(vi_map: VIMap, mission: int) -> str:
    """Return the id of the sensor of a mission that others are mounted on, empty if there is none."""
    kinds = (MissionSensor.IMU, MissionSensor.ODOMETRY_6DOF, MissionSensor.NCAMERA)
    known = vi_map.sensors.sensors
    candidates = (mission_sensor_id(vi_map, mission, kind) for kind in kinds)
    return next((sensor for sensor in candidates if sensor in known), "")


def mounting(vi_map: VIMap, mission: int, sensor_id: str) -> F64:
    """Return T_I_S (7,) of a sensor or camera on the IMU of a mission; empty = the IMU itself.

    Raises:
        UserError: The map has no such sensor.
    """
    if not sensor_id:
        return se3.identity()
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    try:
        return np.asarray(vi_map.sensors.T_I_S(imu_id, sensor_id))
    except MapError as error:
        raise UserError(f"--sensor_id={sensor_id}: {error}") from error


def without_sensors(vi_map: VIMap, words: U64) -> VIMap:
    """Return the map without sensors (N, 2) that no measurement refers to any more."""
    removed = {to_hex(word) for word in words}
    sensors = vi_map.sensors
    return vi_map.replace(
        sensors=type(sensors)(
            {key: sensor for key, sensor in sensors.sensors.items() if key not in removed},
            {key: mount for key, mount in sensors.extrinsics.items() if key not in removed},
            sensors.extra,
        )
    )
