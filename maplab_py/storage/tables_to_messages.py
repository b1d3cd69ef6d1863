"""The files of a VI-map: which entities are in which, and their content as C++ maplab writes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.edges_to_messages import (
    SAMPLES,
    edge_columns,
    edge_counts,
    edges_to_bytes,
)
from maplab_py.storage.file_contents import FileContent, extend_finite, merge_unknown, words
from maplab_py.storage.landmark_index import index_to_bytes
from maplab_py.storage.map_files import FileKind
from maplab_py.storage.tables_from_messages import SENSOR_FIELDS
from maplab_py.storage.vertex_columns import MEASUREMENTS, VertexColumns
from maplab_py.storage.vertices_to_messages import vertices_to_bytes
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.ids import is_valid


@dataclasses.dataclass(frozen=True)
class Partition:
    """Which entities come into one file. The default is that of C++ maplab.

    Attributes:
        vertices: Most vertices of a file.
        edges: Most edges of a file.
        is_stable: Vertices of two missions are in different files, and edges of two kinds. The
            files of a mission then do not change when another one grows.
    """

    vertices: int = 50
    edges: int = 30_000
    is_stable: bool = False

    def vertex_rows(self, vi_map: VIMap) -> list[range]:
        """Return the vertices of each file."""
        counts = np.diff(vi_map.vertex_start).tolist() if self.is_stable else [len(vi_map.vertices)]
        return _portions(counts, self.vertices)

    def edge_rows(self, vi_map: VIMap) -> list[range]:
        """Return the edges of each file, counted in the order of `edge_counts`."""
        counts = edge_counts(vi_map)
        return _portions(counts if self.is_stable else [sum(counts)], self.edges)


def _portions(counts: Sequence[int], most: int) -> list[range]:
    """Return consecutive rows in portions that do not cross from one count to the next."""
    portions, first = [], 0
    for count in counts:
        end = first + count
        portions += [range(a, min(a + most, end)) for a in range(first, end, most)]
        first = end
    return portions or [range(0)]


def contents(vi_map: VIMap, partition: Partition) -> Iterator[FileContent]:
    """Yield the files of a map; that of the missions is written apart (`missions`)."""
    vertices = VertexColumns(vi_map)
    for index, rows in enumerate(partition.vertex_rows(vi_map)):
        name, columns = f"vertices{index}", vertices.of(rows)
        yield FileContent(FileKind.VERTICES, name, columns, vertices_to_bytes, MEASUREMENTS)
    for index, rows in enumerate(partition.edge_rows(vi_map)):
        name, columns = f"edges{index}", edge_columns(vi_map, rows)
        yield FileContent(FileKind.EDGES, name, columns, edges_to_bytes, SAMPLES)
    landmarks = vi_map.landmarks
    columns = {"landmark_id": landmarks.id, "vertex_id": vi_map.vertices.id[landmarks.vertex]}
    yield FileContent(FileKind.LANDMARK_INDEX, "landmark_index", columns, index_to_bytes)


def missions(vi_map: VIMap) -> pb.VIMap:
    """Return the message with missions and base frames."""
    message = pb.VIMap()
    table = vi_map.missions
    frame_words = words(vi_map.baseframes.id)
    for row, id_words in enumerate(words(table.id)):
        message.mission_ids.add().words.extend(id_words)
        mission = message.missions.add()
        mission.baseframe_id.words.extend(frame_words[table.baseframe[row]])
        if table.root_vertex[row] >= 0:
            root = vi_map.vertices.id[table.root_vertex[row]]
            mission.root_vertex_id.words.extend(root.byteswap().tolist())
        mission.backbone = int(table.backbone[row])
        sensor_words = words(table.sensor_id[row])
        for kind, field in SENSOR_FIELDS.items():
            if any(sensor_words[kind]):
                getattr(mission, field).words.extend(sensor_words[kind])
        merge_unknown(mission, table.unknown[row])
    _mission_resources(vi_map, message)
    frames = vi_map.baseframes
    for row, id_words in enumerate(frame_words):
        message.baseframe_ids.add().words.extend(id_words)
        frame = message.baseframes.add()
        frame.T_G_M.extend(frames.T_G_M[row].tolist())
        extend_finite(frame.T_G_M_covariance, frames.T_G_M_covariance[row])
        frame.is_T_G_M_known = bool(frames.is_known[row])
        merge_unknown(frame, frames.unknown[row])
    return message


def _mission_resources(vi_map: VIMap, message: pb.VIMap) -> None:
    table = vi_map.resources
    for row in np.flatnonzero(table.owner_kind == ResourceOwner.MISSION).tolist():
        mission = message.missions[int(table.owner[row])]
        mission.resource_ids.add().words.extend(table.id[row].byteswap().tolist())
        mission.resource_types.append(int(table.type[row]))
    for row in np.flatnonzero(table.owner_kind == ResourceOwner.SENSOR).tolist():
        entry = message.missions[int(table.owner[row])].sensor_resources.add()
        entry.sensor_id.words.extend(table.sensor_id[row].byteswap().tolist())
        entry.timestamp_ns = int(table.timestamp_ns[row])
        entry.resource_id.words.extend(table.id[row].byteswap().tolist())
        entry.resource_type = int(table.type[row])


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
