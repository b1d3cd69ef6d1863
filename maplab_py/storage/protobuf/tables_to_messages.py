"""The files of a VI-map: which entities are in which, and their content as C++ maplab writes it."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from maplab_py.array_types import U64, NDArray
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf import file_contents
from maplab_py.storage.protobuf.map_files import FileKind
from maplab_py.storage.protobuf.tables_from_messages import SENSOR_FIELDS, TRANSFORMATION_FIELDS
from maplab_py.storage.protobuf.vertices_to_messages import id_rows, tag_of, vertices_to_bytes
from maplab_py.vimap import ResourceOwner, TransformationKind, VIMap, is_valid, ragged_rows


@dataclasses.dataclass(frozen=True)
class Partition:
    """Division of entities into files. The default is that of C++ maplab."""

    vertices: int = 50  # most vertices of a file
    edges: int = 30_000  # most edges of a file
    # vertices of two missions are in different files, and edges of two kinds. The files of a mission then do
    # not change when another one grows
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


def contents(vi_map: VIMap, partition: Partition) -> Iterator[file_contents.FileContent]:
    """Yield the files of a map; that of the missions is written apart (`missions`)."""
    vertices = VertexColumns(vi_map)
    for index, rows in enumerate(partition.vertex_rows(vi_map)):
        name, columns = f"vertices{index}", vertices.of(rows)
        yield file_contents.FileContent(
            FileKind.VERTICES, name, columns, vertices_to_bytes, MEASUREMENTS
        )
    for index, rows in enumerate(partition.edge_rows(vi_map)):
        name, columns = f"edges{index}", edge_columns(vi_map, rows)
        yield file_contents.FileContent(FileKind.EDGES, name, columns, edges_to_bytes, SAMPLES)
    landmarks = vi_map.landmarks
    columns = {"landmark_id": landmarks.id, "vertex_id": vi_map.vertices.id[landmarks.vertex]}
    yield file_contents.FileContent(
        FileKind.LANDMARK_INDEX, "landmark_index", columns, index_to_bytes
    )


def missions(vi_map: VIMap) -> pb.VIMap:
    """Return the message with missions and base frames."""
    message = pb.VIMap()
    table = vi_map.missions
    frame_words = file_contents.words(vi_map.baseframes.id)
    for row, id_words in enumerate(file_contents.words(table.id)):
        message.mission_ids.add().words.extend(id_words)
        mission = message.missions.add()
        mission.baseframe_id.words.extend(frame_words[table.baseframe[row]])
        if table.root_vertex[row] >= 0:
            root = vi_map.vertices.id[table.root_vertex[row]]
            mission.root_vertex_id.words.extend(root.byteswap().tolist())
        mission.backbone = int(table.backbone[row])
        sensor_words = file_contents.words(table.sensor_id[row])
        for kind, field in SENSOR_FIELDS.items():
            if any(sensor_words[kind]):
                getattr(mission, field).words.extend(sensor_words[kind])
        file_contents.merge_unknown(mission, table.unknown[row])
    _mission_resources(vi_map, message)
    frames = vi_map.baseframes
    for row, id_words in enumerate(frame_words):
        message.baseframe_ids.add().words.extend(id_words)
        frame = message.baseframes.add()
        frame.T_G_M.extend(frames.T_G_M[row].tolist())
        file_contents.extend_finite(frame.T_G_M_covariance, frames.T_G_M_covariance[row])
        frame.is_T_G_M_known = bool(frames.is_known[row])
        file_contents.merge_unknown(frame, frames.unknown[row])
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


_TRANSFORMATIONS = ("kind", "T_A_B", "covariance", "sensor_id", "unknown")
_LOOP_CLOSURES = (
    "T_A_B",
    "covariance",
    "switch_variable",
    "switch_variable_variance",
    "unknown",
)
SAMPLES = ("sample.timestamp_ns", "sample.accel_gyro")
"""Columns that are parts of the map's own."""


def edge_counts(vi_map: VIMap) -> tuple[int, int, int]:
    """Return the number of inertial edges, of relative poses and of loop closures."""
    return len(vi_map.imu_edges), len(vi_map.transformation_edges), len(vi_map.loop_closure_edges)


def edge_columns(vi_map: VIMap, rows: range) -> file_contents.Columns:
    """Return the columns of edges, which are counted in the order of `edge_counts`."""
    ends = np.cumsum(edge_counts(vi_map))
    imu, relative, loops = (
        slice(max(rows.start - first, 0), max(min(rows.stop, end) - first, 0))
        for first, end in zip((0, *ends[:-1].tolist()), ends.tolist(), strict=True)
    )
    start = vi_map.sample_start
    last = min(imu.stop, len(vi_map.imu_edges))
    samples = slice(int(start[min(imu.start, last)]), int(start[last]))
    return {
        **_ends(vi_map, "imu", vi_map.imu_edges, imu),
        "imu.unknown": vi_map.imu_edges.unknown[imu],
        "imu.sample_count": vi_map.imu_edges.sample_count[imu],
        "sample.timestamp_ns": vi_map.imu_samples.timestamp_ns[samples],
        "sample.accel_gyro": vi_map.imu_samples.accel_gyro[samples],
        **_ends(vi_map, "relative", vi_map.transformation_edges, relative),
        **_part("relative", vi_map.transformation_edges, _TRANSFORMATIONS, relative),
        **_ends(vi_map, "loop", vi_map.loop_closure_edges, loops),
        **_part("loop", vi_map.loop_closure_edges, _LOOP_CLOSURES, loops),
    }


def edges_to_bytes(columns: file_contents.Columns) -> bytes:
    """Return the bytes of a file of edges."""
    message = pb.VIMap()
    _add_imu_edges(message, columns)
    _add_transformations(message, columns)
    _add_loop_closures(message, columns)
    return message.SerializeToString(deterministic=True)


def _ends(vi_map: VIMap, prefix: str, table: Any, rows: slice) -> dict[str, NDArray[Any]]:
    """Return the ids of edges, of their vertices and of their missions."""
    begin = table.from_vertex[rows]
    return {
        f"{prefix}.id": table.id[rows],
        f"{prefix}.from_id": vi_map.vertices.id[begin],
        f"{prefix}.to_id": vi_map.vertices.id[table.to_vertex[rows]],
        f"{prefix}.mission_id": vi_map.missions.id[vi_map.vertices.mission[begin]],
    }


def _part(prefix: str, table: Any, names: tuple[str, ...], rows: Any) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.{name}": getattr(table, name)[rows] for name in names}


class _Ends:
    """Adds edges with the ids of their ends."""

    def __init__(self, message: pb.VIMap, columns: file_contents.Columns, prefix: str) -> None:
        self._message = message
        names = ("id", "from_id", "to_id", "mission_id")
        lists = [file_contents.words(columns[f"{prefix}.{name}"]) for name in names]
        self._rows = list(zip(*lists, strict=True))

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: int, field: str) -> Any:
        """Add an edge of a kind and return its message, ends filled."""
        edge_id, from_id, to_id, mission_id = self._rows[row]
        self._message.edge_ids.add().words.extend(edge_id)
        message = getattr(self._message.edges.add(), field)
        message.from_vertex_id.words.extend(from_id)
        message.to_vertex_id.words.extend(to_id)
        message.mission_id.words.extend(mission_id)
        return message


def _add_imu_edges(message: pb.VIMap, columns: file_contents.Columns) -> None:
    ends = _Ends(message, columns, "imu")
    start = file_contents.starts(columns["imu.sample_count"])
    for row in range(len(ends)):
        imu = ends.add(row, "imu")
        samples = slice(start[row], start[row + 1])
        imu.timestamps_ns.extend(columns["sample.timestamp_ns"][samples].tolist())
        imu.accel_gyro.extend(columns["sample.accel_gyro"][samples].reshape(-1).tolist())
        file_contents.merge_unknown(imu, columns["imu.unknown"][row])


def _add_transformations(message: pb.VIMap, columns: file_contents.Columns) -> None:
    ends = _Ends(message, columns, "relative")
    sensor_words = file_contents.words(columns["relative.sensor_id"])
    for row in range(len(ends)):
        relative = ends.add(
            row, TRANSFORMATION_FIELDS[TransformationKind(columns["relative.kind"][row])]
        )
        relative.T_A_B.extend(columns["relative.T_A_B"][row].tolist())
        file_contents.extend_finite(relative.covariance, columns["relative.covariance"][row])
        relative.sensor_id.words.extend(sensor_words[row])
        file_contents.merge_unknown(relative, columns["relative.unknown"][row])


def _add_loop_closures(message: pb.VIMap, columns: file_contents.Columns) -> None:
    ends = _Ends(message, columns, "loop")
    for row in range(len(ends)):
        loop = ends.add(row, "loop_closure")
        loop.T_A_B.extend(columns["loop.T_A_B"][row].tolist())
        file_contents.extend_finite(loop.covariance, columns["loop.covariance"][row])
        loop.switch_variable = float(columns["loop.switch_variable"][row])
        loop.switch_variable_variance = float(columns["loop.switch_variable_variance"][row])
        file_contents.merge_unknown(loop, columns["loop.unknown"][row])


_VERTICES = ("id", "T_M_I", "v_M", "accel_bias", "gyro_bias", "nframe_id", "unknown")
_FRAMES = (
    "id",
    "timestamp_ns",
    "is_valid",
    "present",
    "keypoint_count",
    "descriptor_blocks",
    "descriptor_layout",
    "unknown",
)
_KEYPOINTS = (
    "uv_px",
    "sigma_px",
    "scale",
    "track_id",
    "position_3d",
    "time_offset_ns",
    "descriptor",
)
MEASUREMENTS = tuple(f"keypoint.{name}" for name in _KEYPOINTS)
"""Columns that are parts of the map's own."""
_LANDMARKS = ("id", "p_I", "covariance", "quality", "feature_type", "unknown")
_ABSOLUTE_POSES = ("timestamp_ns", "sensor_id", "T_G_S", "covariance", "unknown")


class VertexColumns:
    """Makes the columns of vertices by row; both directions of every link are in them."""

    def __init__(self, vi_map: VIMap) -> None:
        """Group what belongs to vertices and frames."""
        self._map = vi_map
        count = len(vi_map.vertices)
        edges = (vi_map.imu_edges, vi_map.transformation_edges, vi_map.loop_closure_edges)
        self._edge_id = np.concatenate([table.id for table in edges])
        self._incoming = file_contents.Groups.of(
            np.concatenate([table.to_vertex for table in edges]), count
        )
        self._outgoing = file_contents.Groups.of(
            np.concatenate([table.from_vertex for table in edges]), count
        )
        self._stored = file_contents.Groups.of(vi_map.landmarks.vertex, count)
        self._absolute = file_contents.Groups.of(vi_map.absolute_poses.vertex, count)
        resources = vi_map.resources
        owner = np.where(resources.owner_kind == ResourceOwner.FRAME, resources.owner, -1)
        self._resources = file_contents.Groups.of(owner, len(vi_map.frames))

    def of(self, rows: range) -> file_contents.Columns:
        """Return the columns of some vertices."""
        m = self._map
        frames = range(int(m.frame_start[rows.start]), int(m.frame_start[rows.stop]))
        keypoints = slice(int(m.keypoint_start[frames.start]), int(m.keypoint_start[frames.stop]))
        landmark = m.keypoints.landmark[keypoints]
        resource = self._resources.members(frames)
        absolute = self._absolute.members(rows)
        vertices = slice(rows.start, rows.stop)
        return {
            **_part("vertex", m.vertices, _VERTICES, vertices),
            "vertex.mission_id": m.missions.id[m.vertices.mission[vertices]],
            "vertex.frame_count": np.diff(m.frame_start[rows.start : rows.stop + 1]),
            "incoming.count": self._incoming.counts(rows),
            "incoming.id": self._edge_id[self._incoming.members(rows)],
            "outgoing.count": self._outgoing.counts(rows),
            "outgoing.id": self._edge_id[self._outgoing.members(rows)],
            **_part("frame", m.frames, _FRAMES, slice(frames.start, frames.stop)),
            **_part("keypoint", m.keypoints, _KEYPOINTS, keypoints),
            "keypoint.is_observation": landmark >= 0,
            "keypoint.landmark_id": _ids_or_zero(m.landmarks.id, landmark),
            "resource.count": self._resources.counts(frames),
            "resource.id": m.resources.id[resource],
            "resource.type": m.resources.type[resource],
            **self._landmark_columns(rows),
            "absolute.count": self._absolute.counts(rows),
            **_part("absolute", m.absolute_poses, _ABSOLUTE_POSES, absolute),
        }

    def _landmark_columns(self, rows: range) -> dict[str, NDArray[Any]]:
        """Return the landmarks that vertices store, and their lists of observations."""
        m = self._map
        landmarks = self._stored.members(rows)
        keypoint = m.observations[ragged_rows(m.observation_start, landmarks)]
        frame = m.keypoint_frame[keypoint]
        return {
            "landmark.count": self._stored.counts(rows),
            **_part("landmark", m.landmarks, _LANDMARKS, landmarks),
            "observation.count": np.diff(m.observation_start)[landmarks]
            if len(m.landmarks)
            else np.zeros(0, dtype=np.int64),
            "observation.vertex_id": m.vertices.id[m.frames.vertex[frame]],
            "observation.keypoint_index": keypoint - m.keypoint_start[frame],
            "observation.frame_index": m.frames.camera_index[frame],
        }


def _ids_or_zero(ids: NDArray[np.uint64], rows: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the ids (N, 2) of rows; zero for negative ones."""
    result = np.zeros((len(rows), 2), dtype=np.uint64)
    known = rows >= 0
    result[known] = ids[rows[known]]
    return result


# The bytes of the landmark index, without an object for each of its entries.
#
# An entry of the message `VIMap` is (protocol buffers, wire format): tag and length; the vertex' id and the
# landmark's (see `id_messages`).


_PORTION = 1 << 16
"""Entries that are converted at once."""
_ENTRY_TAG = tag_of(pb.VIMap, "landmark_index")
_VERTEX_TAG = tag_of(pb.LandmarkIndexEntry, "vertex_id")
_LANDMARK_TAG = tag_of(pb.LandmarkIndexEntry, "landmark_id")


def index_to_bytes(columns: file_contents.Columns) -> bytes:
    """Return the bytes of the index of landmarks (`landmark_id`) by their vertices (`vertex_id`)."""
    vertex, landmark = columns["vertex_id"], columns["landmark_id"]
    return b"".join(
        _entries(vertex[a : a + _PORTION], landmark[a : a + _PORTION])
        for a in range(0, len(landmark), _PORTION)
    )


def _entries(vertex: U64, landmark: U64) -> bytes:
    """Return the bytes of entries with two ids (N, 2) each."""
    parts = [id_rows(vertex, _VERTEX_TAG), id_rows(landmark, _LANDMARK_TAG)]
    sizes = [np.count_nonzero(is_used, axis=1) for _, is_used in parts]
    start = np.empty((len(vertex), 2), dtype=np.uint8)
    start[:, 0], start[:, 1] = _ENTRY_TAG, sizes[0] + sizes[1]
    rows = np.concatenate([start, *(part for part, _ in parts)], axis=1)
    used = [np.ones(start.shape, dtype=np.bool_), *(is_used for _, is_used in parts)]
    return bytes(rows[np.concatenate(used, axis=1)].data)
