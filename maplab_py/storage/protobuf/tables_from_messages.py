"""Convert messages to tables: base frames, missions, vertices and edges."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import I64, U64, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import MapError
from maplab_py.storage.protobuf import message_numbers
from maplab_py.storage.protobuf.ids import ids_of, unknown_bytes
from maplab_py.storage.protobuf.message_numbers import Name
from maplab_py.vimap import IdIndex, as_keys, is_valid, tables, to_hex
from maplab_py.vimap.table import object_column

SENSOR_FIELDS = {
    tables.MissionSensor.NCAMERA: "ncamera_id",
    tables.MissionSensor.IMU: "imu_id",
    tables.MissionSensor.LIDAR: "lidar_id",
    tables.MissionSensor.ODOMETRY_6DOF: "odometry_6dof_id",
    tables.MissionSensor.LOOP_CLOSURE: "loop_closure_id",
    tables.MissionSensor.ABSOLUTE_6DOF: "absolute_6dof_id",
    tables.MissionSensor.DETECTION: "detection_id",
    tables.MissionSensor.WHEEL_ODOMETRY: "wheel_odometry_id",
}
TRANSFORMATION_FIELDS = {
    tables.TransformationKind.ODOMETRY: "odometry",
    tables.TransformationKind.TRANSFORMATION: "transformation",
    tables.TransformationKind.WHEEL_ODOMETRY: "wheel_odometry",
}
_TRANSFORMATIONS = {field: int(kind) for kind, field in TRANSFORMATION_FIELDS.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class Content:
    """The entities of all files of a map, in file order, with their ids (N, 2)."""

    vertex_ids: U64
    vertex_mission_ids: U64
    listed_edges: dict[str, tuple[I64, U64]]  # by field of vertices: vertex row and id of each
    edge_ids: U64
    edges: list[Any]
    mission_ids: U64
    missions: list[Any]
    baseframe_ids: U64
    baseframes: list[Any]
    legacy_landmark_ids: U64
    index_vertex_ids: U64
    index_landmark_ids: U64
    paths: tuple[Path, ...]
    index_path: Path  # of the landmark index
    file_of: dict[str, I64]  # index into paths of every vertex, edge, mission and base frame

    def name(self, kind: str, row: int) -> str:
        """Return file, kind and id of an entity (row in file order), as error messages begin."""
        noun, ids = {
            "vertices": ("vertex", self.vertex_ids),
            "edges": ("edge", self.edge_ids),
            "missions": ("mission", self.mission_ids),
            "baseframes": ("base frame", self.baseframe_ids),
        }[kind]
        return f"{self.paths[self.file_of[kind][row]]}: {noun} {to_hex(ids[row])}"

    def namer(self, kind: str, rows: Any = None) -> Name:
        """Return `name` as a function of the place in a list of rows; None = all."""
        return lambda place: self.name(kind, place if rows is None else int(rows[place]))

    def file_namer(self, kind: str) -> Name:
        """Return a function that gives the file of an entity (row in file order)."""
        return lambda row: str(self.paths[self.file_of[kind][row]])


def unique_index(ids: U64, what: str, file_of: Callable[[int], str]) -> IdIndex:
    """Index ids that must be valid and unique; `file_of` gives the file of a row.

    Raises:
        MapError: An id is zero or occurs twice.
    """
    without = np.flatnonzero(~is_valid(ids))
    if len(without):
        raise MapError(f"{file_of(int(without[0]))}: a {what} has no id")
    keys = as_keys(ids)
    order = np.argsort(keys, kind="stable")
    twice = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    if len(twice):
        row = int(order[twice[0] + 1])
        raise MapError(f"{file_of(row)}: {what} {to_hex(ids[row])} occurs twice")
    return IdIndex(ids)


def required_rows(index: IdIndex, ids: U64, field: str, name: Name) -> I64:
    """Look up ids that must exist.

    Raises:
        MapError: An id does not exist; names the entity that refers to it and the field.
    """
    rows = index.rows(ids)
    missing = np.flatnonzero(rows < 0)
    if len(missing):
        row = int(missing[0])
        if not is_valid(ids[row]):
            raise MapError(f"{name(row)}: has no {field}")
        raise MapError(f"{name(row)}: its {field} {to_hex(ids[row])} is not in the map")
    return rows


def read_baseframes(content: Content) -> tables.BaseFrames:
    """Return the base frames in file order."""
    frames, name = content.baseframes, content.namer("baseframes")
    return tables.BaseFrames.filled(
        len(frames),
        id=content.baseframe_ids,
        T_G_M=message_numbers.poses([b.T_G_M for b in frames], "T_G_M", name),
        T_G_M_covariance=message_numbers.covariances(
            [b.T_G_M_covariance for b in frames], 6, "T_G_M_covariance", name
        ),
        is_known=[b.is_T_G_M_known for b in frames],
        unknown=object_column([unknown_bytes(b) for b in frames]),
    )


def read_missions(
    content: Content, baseframe_rows: IdIndex, vertex_rows: IdIndex, vertex_mission: I64
) -> tables.Missions:
    """Return the missions in file order; `vertex_mission` is the mission row of each vertex."""
    missions = content.missions
    sensor_id = np.zeros((len(missions), len(tables.MissionSensor), 2), dtype=np.uint64)
    for kind, field in SENSOR_FIELDS.items():
        sensor_id[:, kind] = ids_of(
            [getattr(m, field) for m in missions], field, content.namer("missions")
        )
    name = content.namer("missions")
    root_ids = ids_of([m.root_vertex_id for m in missions], "root vertex", name)
    root = vertex_rows.rows(root_ids)
    dangling = np.flatnonzero((root < 0) & is_valid(root_ids))
    if len(dangling):
        row = int(dangling[0])
        raise MapError(f"{name(row)}: its root vertex {to_hex(root_ids[row])} is not in the map")
    inhabited = distinct(np.append(vertex_mission, -1))[1:]
    rootless = inhabited[~is_valid(root_ids[inhabited])]
    if len(rootless):
        raise MapError(f"{name(int(rootless[0]))}: has vertices but no root vertex")
    baseframe_ids = ids_of([m.baseframe_id for m in missions], "base frame", name)
    return tables.Missions.filled(
        len(missions),
        id=content.mission_ids,
        baseframe=required_rows(baseframe_rows, baseframe_ids, "base frame", name),
        root_vertex=root,
        backbone=message_numbers.choices(
            [m.backbone for m in missions], len(tables.Backbone), "backbone", name
        ),
        sensor_id=sensor_id,
        unknown=object_column([unknown_bytes(m) for m in missions]),
    )


def read_vertices(vertices: list[Any], ids: U64, timestamp_ns: I64, name: Name) -> tables.Vertices:
    """Return the vertices in the given order, still without missions."""
    T_M_I = message_numbers.rows([v.T_M_I for v in vertices], 7, "T_M_I", name)
    message_numbers.check_poses(T_M_I, "T_M_I", name)
    return tables.Vertices.filled(
        len(vertices),
        id=ids,
        T_M_I=T_M_I,
        v_M=_vectors([v.v_M for v in vertices], "v_M", name),
        accel_bias=_vectors([v.accel_bias for v in vertices], "accel_bias", name),
        gyro_bias=_vectors([v.gyro_bias for v in vertices], "gyro_bias", name),
        timestamp_ns=timestamp_ns,
        nframe_id=ids_of([v.nframe.id for v in vertices], "id of the n-frame", name),
        unknown=object_column([unknown_bytes(v) for v in vertices]),
    )


def read_absolute_poses(vertices: list[Any], vertex_name: Name) -> tables.AbsolutePoses:
    """Return the absolute measurements of the vertices (in row order)."""
    owned = [(row, m) for row, v in enumerate(vertices) for m in v.absolute_poses]

    def name(place: int) -> str:
        return vertex_name(owned[place][0])

    return tables.AbsolutePoses.filled(
        len(owned),
        vertex=[row for row, _ in owned],
        timestamp_ns=[m.timestamp_ns for _, m in owned],
        sensor_id=ids_of([m.sensor_id for _, m in owned], "sensor of an absolute pose", name),
        T_G_S=message_numbers.poses([m.T_G_S for _, m in owned], "T_G_S of an absolute pose", name),
        covariance=message_numbers.covariances(
            [m.covariance for _, m in owned], 6, "the covariance of an absolute pose", name
        ),
        unknown=object_column([unknown_bytes(m) for _, m in owned]),
    )


def read_imu_edges(
    content: Content, rows: list[int], vertex_rows: IdIndex
) -> tuple[tables.ImuEdges, tables.ImuSamples]:
    """Return inertial edges (rows in file order), sorted by their first vertex, with samples."""
    edges = [content.edges[k].imu for k in rows]
    ids = content.edge_ids[rows]
    first, second = _ends(edges, vertex_rows, content.namer("edges", rows))
    order = np.lexsort((second, first))
    edges = [edges[k] for k in order]
    name = content.namer("edges", np.array(rows, dtype=np.int64)[order])
    counts = np.array([len(e.timestamps_ns) for e in edges], dtype=np.int64)
    for row, (edge, count) in enumerate(zip(edges, counts.tolist(), strict=True)):
        if len(edge.accel_gyro) != 6 * count:
            raise MapError(
                f"{name(row)}: {len(edge.accel_gyro)} measured numbers do not fit "
                f"{count} time stamps (6 each)"
            )
    table = tables.ImuEdges.filled(
        len(edges),
        id=ids[order],
        from_vertex=first[order],
        to_vertex=second[order],
        sample_count=counts,
        unknown=object_column([unknown_bytes(e) for e in edges]),
    )
    times = [np.array(e.timestamps_ns, dtype=np.int64) for e in edges]
    data = [np.array(e.accel_gyro, dtype=np.float64) for e in edges]
    samples = tables.ImuSamples(
        timestamp_ns=np.concatenate(times) if times else np.zeros(0, dtype=np.int64),
        accel_gyro=(np.concatenate(data) if data else np.zeros(0)).reshape(-1, 6),
    )
    owner = np.repeat(np.arange(len(edges)), counts)
    message_numbers.finite(samples.accel_gyro, "the IMU data", lambda row: name(int(owner[row])))
    return table, samples


def read_transformation_edges(
    content: Content, kinds: list[str], vertex_rows: IdIndex
) -> tables.TransformationEdges:
    """Return relative-pose edges, sorted by their first vertex; `kinds` are those of all edges."""
    rows = [k for k, kind in enumerate(kinds) if kind in _TRANSFORMATIONS]
    edges = [getattr(content.edges[k], kinds[k]) for k in rows]
    name = content.namer("edges", rows)
    first, second = _ends(edges, vertex_rows, name)
    table = tables.TransformationEdges.filled(
        len(edges),
        id=content.edge_ids[rows],
        kind=[_TRANSFORMATIONS[kinds[k]] for k in rows],
        from_vertex=first,
        to_vertex=second,
        T_A_B=message_numbers.poses([e.T_A_B for e in edges], "T_A_B", name),
        covariance=message_numbers.covariances(
            [e.covariance for e in edges], 6, "T_A_B_covariance", name
        ),
        sensor_id=ids_of([e.sensor_id for e in edges], "sensor", name),
        unknown=object_column([unknown_bytes(e) for e in edges]),
    )
    return table.take(np.lexsort((second, first, table.kind)))


def read_loop_closures(
    content: Content, rows: list[int], vertex_rows: IdIndex
) -> tables.LoopClosureEdges:
    """Return loop-closure edges (rows in file order)."""
    edges = [content.edges[k].loop_closure for k in rows]
    name = content.namer("edges", rows)
    first, second = _ends(edges, vertex_rows, name)
    return tables.LoopClosureEdges.filled(
        len(edges),
        id=content.edge_ids[rows],
        from_vertex=first,
        to_vertex=second,
        T_A_B=message_numbers.poses([e.T_A_B for e in edges], "T_A_B", name),
        covariance=message_numbers.covariances(
            [e.covariance for e in edges], 6, "T_A_B_covariance", name
        ),
        switch_variable=[
            e.switch_variable if e.HasField("switch_variable") else 1.0 for e in edges
        ],
        switch_variable_variance=[e.switch_variable_variance for e in edges],
        unknown=object_column([unknown_bytes(e) for e in edges]),
    )


def _ends(edges: list[Any], vertex_rows: IdIndex, name: Name) -> tuple[I64, I64]:
    first = ids_of([e.from_vertex_id for e in edges], "from-vertex", name)
    second = ids_of([e.to_vertex_id for e in edges], "to-vertex", name)
    return (
        required_rows(vertex_rows, first, "from-vertex", name),
        required_rows(vertex_rows, second, "to-vertex", name),
    )


def _vectors(fields: list[Any], where: str, name: Name) -> NDArray[np.float64]:
    return message_numbers.finite(message_numbers.rows_or(fields, 3, 0.0, where, name), where, name)
