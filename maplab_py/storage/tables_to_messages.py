"""Convert the tables of a VI-map to messages, as C++ maplab writes them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.tables_from_messages import SENSOR_FIELDS
from maplab_py.storage.vertices_to_messages import VertexWriter
from maplab_py.vimap import ResourceOwner, TransformationKind, VIMap
from maplab_py.vimap.ids import is_valid

_VERTICES_PER_FILE = 50
_EDGES_PER_FILE = 30_000

_TRANSFORMATION_FIELDS = {
    TransformationKind.ODOMETRY: "odometry",
    TransformationKind.TRANSFORMATION: "transformation",
    TransformationKind.WHEEL_ODOMETRY: "wheel_odometry",
}


def messages(vi_map: VIMap) -> Iterator[tuple[int, str, pb.VIMap]]:
    """Yield file type (0 missions, 1 vertices, 2 edges, 3 landmark index), file name and content."""
    yield 0, "missions", _missions(vi_map)
    writer = VertexWriter(vi_map)
    count = len(vi_map.vertices)
    for index, begin in enumerate(range(0, max(count, 1), _VERTICES_PER_FILE)):
        rows = range(begin, min(begin + _VERTICES_PER_FILE, count))
        yield 1, f"vertices{index}", writer.message(rows)
    edges = list(_edges(vi_map))
    for index, begin in enumerate(range(0, max(len(edges), 1), _EDGES_PER_FILE)):
        message = pb.VIMap()
        for edge_id, edge in edges[begin : begin + _EDGES_PER_FILE]:
            message.edge_ids.add().words.extend(edge_id)
            message.edges.append(edge)
        yield 2, f"edges{index}", message
    yield 3, "landmark_index", _landmark_index(vi_map)


def _words(ids: NDArray[np.uint64]) -> list[list[int]]:
    return ids.byteswap().tolist()  # type: ignore[no-any-return]


def _merge_unknown(message: Any, unknown: bytes) -> None:
    if unknown:
        message.MergeFromString(unknown)


def _missions(vi_map: VIMap) -> pb.VIMap:
    message = pb.VIMap()
    table = vi_map.missions
    vertex_words, frame_words = _words(vi_map.vertices.id), _words(vi_map.baseframes.id)
    sensor_words = [_words(ids) for ids in table.sensor_id]
    for row, words in enumerate(_words(table.id)):
        message.mission_ids.add().words.extend(words)
        mission = message.missions.add()
        mission.baseframe_id.words.extend(frame_words[table.baseframe[row]])
        if table.root_vertex[row] >= 0:
            mission.root_vertex_id.words.extend(vertex_words[table.root_vertex[row]])
        mission.backbone = int(table.backbone[row])
        for kind, field in SENSOR_FIELDS.items():
            if any(sensor_words[row][kind]):
                getattr(mission, field).words.extend(sensor_words[row][kind])
        _merge_unknown(mission, table.unknown[row])
    _mission_resources(vi_map, message)
    frames = vi_map.baseframes
    for row, words in enumerate(frame_words):
        message.baseframe_ids.add().words.extend(words)
        frame = message.baseframes.add()
        frame.T_G_M.extend(frames.T_G_M[row].tolist())
        _extend_finite(frame.T_G_M_covariance, frames.T_G_M_covariance[row])
        frame.is_T_G_M_known = bool(frames.is_known[row])
        _merge_unknown(frame, frames.unknown[row])
    return message


def _mission_resources(vi_map: VIMap, message: pb.VIMap) -> None:
    table = vi_map.resources
    words, sensor_words = _words(table.id), _words(table.sensor_id)
    for row in np.flatnonzero(table.owner_kind == ResourceOwner.MISSION).tolist():
        mission = message.missions[int(table.owner[row])]
        mission.resource_ids.add().words.extend(words[row])
        mission.resource_types.append(int(table.type[row]))
    for row in np.flatnonzero(table.owner_kind == ResourceOwner.SENSOR).tolist():
        entry = message.missions[int(table.owner[row])].sensor_resources.add()
        entry.sensor_id.words.extend(sensor_words[row])
        entry.timestamp_ns = int(table.timestamp_ns[row])
        entry.resource_id.words.extend(words[row])
        entry.resource_type = int(table.type[row])


def _edges(vi_map: VIMap) -> Iterator[tuple[list[int], pb.Edge]]:
    vertex_words = _words(vi_map.vertices.id)
    mission_words = _words(vi_map.missions.id[vi_map.vertices.mission])
    yield from _imu_edges(vi_map, vertex_words, mission_words)
    relative = vi_map.transformation_edges
    sensor_words = _words(relative.sensor_id)
    for row, words in enumerate(_words(relative.id)):
        edge = pb.Edge()
        message = getattr(edge, _TRANSFORMATION_FIELDS[TransformationKind(relative.kind[row])])
        _ends(message, relative, row, vertex_words, mission_words)
        message.T_A_B.extend(relative.T_A_B[row].tolist())
        _extend_finite(message.covariance, relative.covariance[row])
        message.sensor_id.words.extend(sensor_words[row])
        _merge_unknown(message, relative.unknown[row])
        yield words, edge
    loops = vi_map.loop_closure_edges
    for row, words in enumerate(_words(loops.id)):
        edge = pb.Edge()
        loop = edge.loop_closure
        _ends(loop, loops, row, vertex_words, mission_words)
        loop.T_A_B.extend(loops.T_A_B[row].tolist())
        _extend_finite(loop.covariance, loops.covariance[row])
        loop.switch_variable = float(loops.switch_variable[row])
        loop.switch_variable_variance = float(loops.switch_variable_variance[row])
        _merge_unknown(loop, loops.unknown[row])
        yield words, edge


def _imu_edges(
    vi_map: VIMap, vertex_words: list[list[int]], mission_words: list[list[int]]
) -> Iterator[tuple[list[int], pb.Edge]]:
    table, samples, start = vi_map.imu_edges, vi_map.imu_samples, vi_map.sample_start
    for row, words in enumerate(_words(table.id)):
        edge = pb.Edge()
        _ends(edge.imu, table, row, vertex_words, mission_words)
        samples_of_edge = slice(start[row], start[row + 1])
        edge.imu.timestamps_ns.extend(samples.timestamp_ns[samples_of_edge].tolist())
        edge.imu.accel_gyro.extend(samples.accel_gyro[samples_of_edge].reshape(-1).tolist())
        _merge_unknown(edge.imu, table.unknown[row])
        yield words, edge


def _ends(
    message: Any,
    table: Any,
    row: int,
    vertex_words: list[list[int]],
    mission_words: list[list[int]],
) -> None:
    message.from_vertex_id.words.extend(vertex_words[table.from_vertex[row]])
    message.to_vertex_id.words.extend(vertex_words[table.to_vertex[row]])
    message.mission_id.words.extend(mission_words[table.from_vertex[row]])


def _extend_finite(field: Any, covariance: NDArray[np.float64]) -> None:
    """Write a covariance unless the map has none (NaN)."""
    if np.isfinite(covariance).all():
        field.extend(covariance.reshape(-1).tolist())


def _landmark_index(vi_map: VIMap) -> pb.VIMap:
    message = pb.VIMap()
    vertex_words = _words(vi_map.vertices.id)
    for words, vertex in zip(
        _words(vi_map.landmarks.id), vi_map.landmarks.vertex.tolist(), strict=True
    ):
        entry = message.landmark_index.add()
        entry.vertex_id.words.extend(vertex_words[vertex])
        entry.landmark_id.words.extend(words)
    return message


def resource_info(vi_map: VIMap) -> pb.ResourceInfoMap:
    """Return the folder of each resource, one entry per resource id."""
    table = vi_map.resources
    _, first = np.unique(table.id, axis=0, return_index=True)
    message = pb.ResourceInfoMap()
    for row in np.sort(first[is_valid(table.id[first])]).tolist():
        message.resource_type.append(int(table.type[row]))
        message.resource_id.add().words.extend(table.id[row].byteswap().tolist())
        message.resource_info.add().folder_idx = int(table.folder[row])
    return message
