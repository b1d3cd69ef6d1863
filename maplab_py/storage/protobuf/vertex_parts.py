"""Convert the messages of one file of vertices to tables, and join those of all files.

The messages of a file take several times the memory of its tables, so they are given back before the next
file is read.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from maplab_py.array_types import I64, U64
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf import frames_from_messages as frame_messages
from maplab_py.storage.protobuf import resources_from_messages, tables_from_messages
from maplab_py.storage.protobuf.ids import ids_of, ids_of_field
from maplab_py.storage.protobuf.message_numbers import Name
from maplab_py.vimap import AbsolutePoses, Frames, Keypoints, Landmarks, Resources, Vertices, to_hex
from maplab_py.vimap.table import Table, ragged_rows, stacked_columns, starts_of_counts

T = TypeVar("T", bound=Table)
NO_TIME = np.iinfo(np.int64).min
"""Time of a vertex without stamped frames."""
_NO_COLUMN: dict[str, Any] = {
    "landmark_ids": np.zeros((0, 2), dtype=np.uint64),
    "observers": np.zeros((0, 2), dtype=np.uint64),
    "frame_index": np.zeros(0, dtype=np.int64),
    "keypoint_index": np.zeros(0, dtype=np.int64),
    "owner": np.zeros(0, dtype=np.int64),
}
LISTED_EDGES = ("outgoing_edges", "incoming_edges")


@dataclasses.dataclass(eq=False)
class VertexPart:
    """The entities of one file, rows in file order; joining takes them away."""

    mission_ids: U64  # (V, 2)
    tables: dict[type[Table], Table]
    columns: dict[str, Any]  # landmark ids of keypoints, and the landmarks' own observation lists
    listed: dict[str, tuple[I64, U64]]  # edges that vertices list: vertex row and id of each
    count: int
    frames: int
    landmarks: int

    def timestamp_ns(self) -> I64:
        """Return the times of the vertices; NO_TIME = unknown."""
        vertices = self.tables[Vertices]
        assert isinstance(vertices, Vertices)
        return vertices.timestamp_ns

    def nbytes(self) -> int:
        """Return the memory of all columns in bytes."""
        tables = sum(table.nbytes() for table in self.tables.values())
        return tables + sum(int(column.nbytes) for column in self.columns.values())


def read_part(path: Path, message: pb.VIMap, max_bytes: int) -> VertexPart:
    """Return the tables of the vertices of one file.

    Raises:
        MapError: An entity is damaged; names file, entity and field.
    """
    vertices = list(message.vertices)
    ids = ids_of(message.vertex_ids, f"{path}: vertex_ids")

    def name(row: int) -> str:
        return f"{path}: vertex {to_hex(ids[row])}"

    content = frame_messages.read_frames(vertices, name, max_bytes)
    landmarks, listed = frame_messages.read_landmarks(vertices, name)
    frame_start = starts_of_counts(np.bincount(content.frames.vertex, minlength=len(vertices)))
    resources = resources_from_messages.resources_of_frames(vertices, frame_start)
    return VertexPart(
        mission_ids=ids_of([v.mission_id for v in vertices], "mission", name),
        tables={
            Vertices: tables_from_messages.read_vertices(vertices, ids, _times(vertices), name),
            Frames: content.frames,
            Keypoints: content.keypoints,
            Landmarks: landmarks,
            AbsolutePoses: tables_from_messages.read_absolute_poses(vertices, name),
            Resources: resources,
        },
        columns={"landmark_ids": content.landmark_ids, **listed},
        listed={field: _listed(vertices, field, name) for field in LISTED_EDGES},
        count=len(vertices),
        frames=len(content.frames),
        landmarks=len(landmarks),
    )


def _times(vertices: list[Any]) -> I64:
    """Return the time of every vertex: that of its first stamped frame, else NO_TIME."""
    times = np.full(len(vertices), NO_TIME)
    for row, vertex in enumerate(vertices):
        stamps = [f.timestamp_ns for f in vertex.nframe.frames if any(f.id.words)]
        if any(stamps):  # a stamp that is missing reads as 0
            times[row] = min(stamps)
    return times


def _listed(vertices: list[Any], field: str, name: Name) -> tuple[I64, U64]:
    ids, counts = ids_of_field(vertices, field, f"{field} of a vertex", name)
    return np.repeat(np.arange(len(counts)), counts), ids


class JoinedParts:
    """The entities of all files, vertices in the order of the map's rows."""

    def __init__(self, parts: Sequence[VertexPart], order: I64) -> None:
        """Take the parts, and the place (V,) in file order of every vertex row."""
        self._parts = parts
        self.order = order
        self.row = np.empty(len(order), dtype=np.int64)  # of every vertex in file order
        self.row[order] = np.arange(len(order))

    def vertices(self) -> Vertices:
        """Return the vertices; missions and times are those of the parts."""
        return self._joined(Vertices, _unless_sorted(self.order))

    def frames(self, max_bytes: int) -> frame_messages.FrameContent:
        """Return the frames with their keypoints, and the ids of the keypoints' landmarks.

        Raises:
            MapError: Descriptors of different sizes would take more memory than the bound.
        """
        frames = self._of_vertices(Frames)
        frame_messages.check_descriptor_table(frames, max_bytes)
        rows, frames = _sorted_by_vertex(frames)
        keypoint_rows = None
        if rows is not None:
            counts = np.empty(len(rows), dtype=np.int64)
            counts[rows] = frames.keypoint_count
            keypoint_rows = ragged_rows(starts_of_counts(counts), rows)
        self._frame_row = _inverse(rows, len(frames))
        return frame_messages.FrameContent(
            frames=frames,
            keypoints=self._joined(Keypoints, keypoint_rows),
            landmark_ids=self._column("landmark_ids", keypoint_rows),
            name=str,
        )

    def landmarks(self) -> tuple[Landmarks, frame_messages.ListedObservations]:
        """Return the landmarks and their own lists of observations."""
        rows, landmarks = _sorted_by_vertex(self._of_vertices(Landmarks))
        first = self._first([part.landmarks for part in self._parts])
        for part, start in zip(self._parts, first, strict=True):
            part.columns["owner"] = part.columns["owner"] + start
        owner = _inverse(rows, len(landmarks))[self._column("owner")]
        return landmarks, frame_messages.ListedObservations(
            self._column("observers"),
            self._column("frame_index"),
            self._column("keypoint_index"),
            owner,
        )

    def absolute_poses(self) -> AbsolutePoses:
        """Return the absolute measurements by vertex."""
        return _sorted_by_vertex(self._of_vertices(AbsolutePoses))[1]

    def resources_of_frames(self) -> Resources:
        """Return the resources of frames by frame; `frames` comes first."""
        first = self._first([part.frames for part in self._parts])
        for part, start in zip(self._parts, first, strict=True):
            table = part.tables[Resources]
            part.tables[Resources] = table.replace(owner=table.columns()["owner"] + start)
        resources = self._joined(Resources)
        resources = resources.replace(owner=self._frame_row[resources.owner])
        return resources.take(np.argsort(resources.owner, kind="stable"))

    def _of_vertices(self, kind: type[T]) -> T:
        """Return a table whose column `vertex` refers to rows of the map."""
        first = self._first([part.count for part in self._parts])
        for part, start in zip(self._parts, first, strict=True):
            table = part.tables[kind]
            part.tables[kind] = table.replace(vertex=self.row[table.columns()["vertex"] + start])
        return self._joined(kind)

    def _joined(self, kind: type[T], rows: I64 | None = None) -> T:
        """Stack a table of all parts, which lose it; in another order of rows where one is given."""
        if not self._parts:
            return kind.empty()
        columns = [part.tables.pop(kind).columns() for part in self._parts]
        return kind(**stacked_columns(columns, rows))

    def _column(self, name: str, rows: I64 | None = None) -> Any:
        columns = [part.columns.pop(name) for part in self._parts]
        stacked = np.concatenate(columns) if columns else _NO_COLUMN[name]
        return stacked if rows is None else stacked[rows]

    @staticmethod
    def _first(counts: list[int]) -> I64:
        return starts_of_counts(np.array(counts, dtype=np.int64))[:-1]


def _sorted_by_vertex(table: T) -> tuple[I64 | None, T]:
    """Return a table sorted by its column `vertex`, and the order of rows; None = as it was."""
    rows = _unless_sorted(np.argsort(table.columns()["vertex"], kind="stable"))
    return rows, table if rows is None else table.take(rows)


def _unless_sorted(rows: I64) -> I64 | None:
    return None if bool(np.array_equal(rows, np.arange(len(rows)))) else rows


def _inverse(rows: I64 | None, count: int) -> I64:
    """Return the new row of every old one."""
    new_row = np.arange(count)
    if rows is not None:
        new_row[rows] = np.arange(count)
    return new_row
