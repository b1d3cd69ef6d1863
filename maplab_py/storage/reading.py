"""From messages to the tables of a VI-map."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.storage import numbers
from maplab_py.storage.words import ids_of, unknown_bytes
from maplab_py.vimap.ids import IdIndex, as_keys, is_valid, to_hex
from maplab_py.vimap.tables import (
    AbsolutePoses,
    BaseFrames,
    ImuEdges,
    ImuSamples,
    LoopClosureEdges,
    Missions,
    MissionSensor,
    TransformationEdges,
    TransformationKind,
    Vertices,
)

U64 = NDArray[np.uint64]
I64 = NDArray[np.int64]

SENSOR_FIELDS = {
    MissionSensor.NCAMERA: "ncamera_id",
    MissionSensor.IMU: "imu_id",
    MissionSensor.LIDAR: "lidar_id",
    MissionSensor.ODOMETRY_6DOF: "odometry_6dof_id",
    MissionSensor.LOOP_CLOSURE: "loop_closure_id",
    MissionSensor.ABSOLUTE_6DOF: "absolute_6dof_id",
    MissionSensor.DETECTION: "detection_id",
    MissionSensor.WHEEL_ODOMETRY: "wheel_odometry_id",
}


@dataclasses.dataclass(frozen=True, eq=False)
class Content:
    """The entities of all files of a map, in file order, with their ids (N, 2)."""

    vertex_ids: U64
    vertices: list[Any]
    edge_ids: U64
    edges: list[Any]
    mission_ids: U64
    missions: list[Any]
    baseframe_ids: U64
    baseframes: list[Any]
    legacy_landmark_ids: U64
    index_vertex_ids: U64
    index_landmark_ids: U64


def unique_index(ids: U64, what: str) -> IdIndex:
    """Index ids that must be valid and unique.

    Raises:
        MapError: One is zero or occurs twice.
    """
    if len(ids) and not is_valid(ids).all():
        raise MapError(f"a {what} has no id")
    keys = as_keys(ids)
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    if len(twice):
        raise MapError(f"{what} {to_hex(ids[order[twice[0]]])} is there twice")
    return IdIndex(ids)


def required_rows(index: IdIndex, ids: U64, what: str) -> I64:
    """Look ids up that must exist.

    Raises:
        MapError: One does not; `what` says whose reference it is.
    """
    found = index.rows(ids)
    missing = np.flatnonzero(found < 0)
    if len(missing):
        raise MapError(f"{what} refers to {to_hex(ids[missing[0]])}, which is not in the map")
    return found


def read_baseframes(content: Content) -> BaseFrames:
    """Return the base frames in file order."""
    frames = content.baseframes
    return BaseFrames.filled(
        len(frames),
        id=content.baseframe_ids,
        T_G_M=numbers.poses([b.T_G_M for b in frames], "T_G_M of a base frame"),
        T_G_M_covariance=numbers.covariances(
            [b.T_G_M_covariance for b in frames], 6, "the covariance of a base frame"
        ),
        is_known=[b.is_T_G_M_known for b in frames],
        unknown=_objects([unknown_bytes(b) for b in frames]),
    )


def read_missions(content: Content, baseframe_rows: IdIndex, vertex_rows: IdIndex) -> Missions:
    """Return the missions in file order."""
    missions = content.missions
    sensor_id = np.zeros((len(missions), len(MissionSensor), 2), dtype=np.uint64)
    for kind, field in SENSOR_FIELDS.items():
        sensor_id[:, kind] = ids_of([getattr(m, field) for m in missions], f"mission {field}")
    root_ids = ids_of([m.root_vertex_id for m in missions], "root vertex of a mission")
    root = vertex_rows.rows(root_ids)
    dangling = np.flatnonzero((root < 0) & is_valid(root_ids))
    if len(dangling):
        raise MapError(
            f"mission {to_hex(content.mission_ids[dangling[0]])} begins at vertex "
            f"{to_hex(root_ids[dangling[0]])}, which is not in the map"
        )
    baseframe_ids = ids_of([m.baseframe_id for m in missions], "base frame of a mission")
    return Missions.filled(
        len(missions),
        id=content.mission_ids,
        baseframe=required_rows(baseframe_rows, baseframe_ids, "the base frame of a mission"),
        root_vertex=root,
        backbone=[m.backbone for m in missions],
        sensor_id=sensor_id,
        unknown=_objects([unknown_bytes(m) for m in missions]),
    )


def read_vertices(content: Content, order: I64, mission: I64, timestamp_ns: I64) -> Vertices:
    """Return the vertices, rows in the given order of the file's entities."""
    vertices = [content.vertices[k] for k in order]
    T_M_I = numbers.rows([v.T_M_I for v in vertices], 7, "T_M_I of a vertex")
    numbers.check_poses(T_M_I, "T_M_I of a vertex")
    return Vertices.filled(
        len(vertices),
        id=content.vertex_ids[order],
        mission=mission,
        T_M_I=T_M_I,
        v_M=_vectors([v.v_M for v in vertices], "v_M of a vertex"),
        accel_bias=_vectors([v.accel_bias for v in vertices], "accel_bias of a vertex"),
        gyro_bias=_vectors([v.gyro_bias for v in vertices], "gyro_bias of a vertex"),
        timestamp_ns=timestamp_ns,
        nframe_id=ids_of([v.nframe.id for v in vertices], "n-frame of a vertex"),
        unknown=_objects([unknown_bytes(v) for v in vertices]),
    )


def read_absolute_poses(vertices: list[Any]) -> AbsolutePoses:
    """Return the absolute measurements of the vertices (in row order)."""
    owned = [(row, m) for row, v in enumerate(vertices) for m in v.absolute_poses]
    return AbsolutePoses.filled(
        len(owned),
        vertex=[row for row, _ in owned],
        timestamp_ns=[m.timestamp_ns for _, m in owned],
        sensor_id=ids_of([m.sensor_id for _, m in owned], "sensor of an absolute pose"),
        T_G_S=numbers.poses([m.T_G_S for _, m in owned], "T_G_S of an absolute pose"),
        covariance=numbers.covariances(
            [m.covariance for _, m in owned], 6, "the covariance of an absolute pose"
        ),
        unknown=_objects([unknown_bytes(m) for _, m in owned]),
    )


def read_imu_edges(ids: U64, edges: list[Any], vertex_rows: IdIndex) -> tuple[ImuEdges, ImuSamples]:
    """Return inertial edges, sorted by their first vertex, with their samples."""
    first, second = _ends(edges, vertex_rows, "an IMU edge")
    order = np.lexsort((second, first))
    edges = [edges[k] for k in order]
    counts = np.array([len(e.timestamps_ns) for e in edges], dtype=np.int64)
    for edge_id, edge, count in zip(ids[order], edges, counts.tolist(), strict=True):
        if len(edge.accel_gyro) != 6 * count:
            raise MapError(
                f"IMU edge {to_hex(edge_id)}: {len(edge.accel_gyro)} measured numbers do not fit "
                f"{count} time stamps (6 each)"
            )
    table = ImuEdges.filled(
        len(edges),
        id=ids[order],
        from_vertex=first[order],
        to_vertex=second[order],
        sample_count=counts,
        unknown=_objects([unknown_bytes(e) for e in edges]),
    )
    times = [np.array(e.timestamps_ns, dtype=np.int64) for e in edges]
    data = [np.array(e.accel_gyro, dtype=np.float64) for e in edges]
    samples = ImuSamples(
        timestamp_ns=np.concatenate(times) if times else np.zeros(0, dtype=np.int64),
        accel_gyro=(np.concatenate(data) if data else np.zeros(0)).reshape(-1, 6),
    )
    numbers.finite(samples.accel_gyro, "the IMU data")
    return table, samples


def read_transformation_edges(
    kinds: list[TransformationKind], ids: U64, edges: list[Any], vertex_rows: IdIndex
) -> TransformationEdges:
    """Return relative-pose edges, sorted by their first vertex."""
    first, second = _ends(edges, vertex_rows, "a relative-pose edge")
    table = TransformationEdges.filled(
        len(edges),
        id=ids,
        kind=[int(kind) for kind in kinds],
        from_vertex=first,
        to_vertex=second,
        T_A_B=numbers.poses([e.T_A_B for e in edges], "T_A_B of a relative-pose edge"),
        covariance=numbers.covariances(
            [e.covariance for e in edges], 6, "the covariance of a relative-pose edge"
        ),
        sensor_id=ids_of([e.sensor_id for e in edges], "sensor of a relative-pose edge"),
        unknown=_objects([unknown_bytes(e) for e in edges]),
    )
    return table.take(np.lexsort((second, first, table.kind)))


def read_loop_closures(ids: U64, edges: list[Any], vertex_rows: IdIndex) -> LoopClosureEdges:
    """Return loop-closure edges in file order."""
    first, second = _ends(edges, vertex_rows, "a loop-closure edge")
    return LoopClosureEdges.filled(
        len(edges),
        id=ids,
        from_vertex=first,
        to_vertex=second,
        T_A_B=numbers.poses([e.T_A_B for e in edges], "T_A_B of a loop-closure edge"),
        covariance=numbers.covariances(
            [e.covariance for e in edges], 6, "the covariance of a loop-closure edge"
        ),
        switch_variable=[
            e.switch_variable if e.HasField("switch_variable") else 1.0 for e in edges
        ],
        switch_variable_variance=[e.switch_variable_variance for e in edges],
        unknown=_objects([unknown_bytes(e) for e in edges]),
    )


def _ends(edges: list[Any], vertex_rows: IdIndex, what: str) -> tuple[I64, I64]:
    first = ids_of([e.from_vertex_id for e in edges], f"first vertex of {what}")
    second = ids_of([e.to_vertex_id for e in edges], f"second vertex of {what}")
    return required_rows(vertex_rows, first, what), required_rows(vertex_rows, second, what)


def _vectors(fields: list[Any], where: str) -> NDArray[np.float64]:
    return numbers.finite(numbers.rows_or(fields, 3, 0.0, where), where)


def _objects(values: list[Any]) -> NDArray[Any]:
    """Make a column of objects (bytes of unknown fields)."""
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column
