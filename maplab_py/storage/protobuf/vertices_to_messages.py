"""Convert the columns of a file of vertices to a message, as C++ maplab writes it."""

import dataclasses
from typing import Any

import numpy as np
from google.protobuf.message import Message

from maplab_py.array_types import I64, U8, U64, Mask
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.protobuf.descriptor_layout import pack
from maplab_py.storage.protobuf.file_contents import (
    Columns,
    extend_finite,
    merge_unknown,
    starts,
    words,
)
from maplab_py.vimap import table, tables

# The bytes of repeated fields of ids, without an object for each of them.
#
# An id is a message with two words. In a repeated field (protocol buffers, wire format) it is the field's tag
# and its length, and for each word a tag and a varint.


_VARINT = 10
"""Most bytes of a word."""
_LENGTH_DELIMITED = 2
_SHORT_TAGS = 128
_WORD = 1 + _VARINT
_ROW = 2 + 2 * _WORD
_WORD_TAG = pb.Id.DESCRIPTOR.fields_by_name["words"].number << 3


@dataclasses.dataclass(frozen=True)
class IdFields:
    """The bytes of ids in a repeated field."""

    data: bytes  # the bytes of all of them
    start: list[int]  # offsets (N + 1) into them

    def of(self, rows: slice) -> bytes:
        """Return the bytes of consecutive ids."""
        return self.data[self.start[rows.start] : self.start[rows.stop]]


def tag_of(message: type[Message], name: str) -> int:
    """Return the tag of a message's field of messages; ValueError where it takes more than a byte."""
    tag = int(message.DESCRIPTOR.fields_by_name[name].number) << 3 | _LENGTH_DELIMITED
    if tag >= _SHORT_TAGS:
        raise ValueError(f"the tag of {name} takes more than a byte")
    return tag


def id_fields(ids: U64, tag: int) -> IdFields:
    """Return ids (N, 2) as elements of a repeated field with a tag."""
    rows, is_used = id_rows(ids, tag)
    start: I64 = table.starts_of_counts(np.count_nonzero(is_used, axis=1))
    return IdFields(rows[is_used].tobytes(), start.tolist())


def id_rows(ids: U64, tag: int) -> tuple[U8, Mask]:
    """Return ids (N, 2) as bytes (N, 24), and which of them are used.

    Args:
        tag: Tag of the field that has them.
    """
    varints, sizes = _varints(ids.byteswap())
    rows = np.empty((len(ids), _ROW), dtype=np.uint8)
    is_used = np.ones(rows.shape, dtype=np.bool_)
    rows[:, 0], rows[:, 1] = tag, 2 + sizes.sum(axis=1)
    for word, first in enumerate((2, 2 + _WORD)):
        rows[:, first], rows[:, first + 1 : first + _WORD] = _WORD_TAG, varints[:, word]
        is_used[:, first + 1 : first + _WORD] = np.arange(_VARINT) < sizes[:, word, None]
    return rows, is_used


def _varints(words: U64) -> tuple[U8, U8]:
    """Return words (...) as varints (..., 10), and the number of bytes (...) of each."""
    shifts = np.arange(0, 7 * _VARINT, 7, dtype=np.uint64)
    rest = words[..., None] >> shifts
    size = np.maximum(np.count_nonzero(rest, axis=-1), 1).astype(np.uint8)
    groups = (rest & np.uint64(0x7F)).astype(np.uint8)
    has_more = np.arange(_VARINT) < size[..., None] - 1
    return groups | has_more.astype(np.uint8) << 7, size


_COUNTS = {
    "incoming": "incoming.count",
    "outgoing": "outgoing.count",
    "frame": "vertex.frame_count",
    "keypoint": "frame.keypoint_count",
    "resource": "resource.count",
    "landmark": "landmark.count",
    "observation": "observation.count",
    "absolute": "absolute.count",
}
"""Columns with the number of entities that each vertex, frame or landmark has."""
_IDS = (
    "vertex.id",
    "vertex.mission_id",
    "vertex.nframe_id",
    "incoming.id",
    "outgoing.id",
    "frame.id",
    "resource.id",
    "landmark.id",
    "absolute.sensor_id",
)
_ID_FIELDS = {
    "keypoint.landmark_id": tag_of(pb.VisualFrame, "landmark_ids"),
    "observation.vertex_id": tag_of(pb.Landmark, "observer_vertex_ids"),
}
"""Columns with ids that are too many for an object each, and the tags of their fields."""
_NUMBERS = (
    "vertex.T_M_I",
    "vertex.v_M",
    "vertex.accel_bias",
    "vertex.gyro_bias",
    "frame.timestamp_ns",
    "frame.is_valid",
    "frame.present",
    "frame.descriptor_layout",
    "resource.type",
    "landmark.p_I",
    "landmark.quality",
    "landmark.feature_type",
    "observation.keypoint_index",
    "observation.frame_index",
    "absolute.timestamp_ns",
    "absolute.T_G_S",
)


def vertices_to_bytes(columns: Columns) -> bytes:
    """Return the bytes of a file of vertices."""
    message = _VertexFile(columns).message()
    return message.SerializeToString(deterministic=True)


class _VertexFile:
    """Columns of one file as lists."""

    def __init__(self, columns: Columns) -> None:
        self._columns = columns
        self._start = {name: starts(columns[count]) for name, count in _COUNTS.items()}
        self._words = {name: words(columns[name]) for name in _IDS}
        self._fields = {n: id_fields(columns[n], tag) for n, tag in _ID_FIELDS.items()}
        self._numbers = {name: columns[name].tolist() for name in _NUMBERS}
        observed = starts(columns["keypoint.is_observation"])
        bounds = self._start["keypoint"]
        self._observed = [observed[row] for row in bounds]  # observations before each frame

    def message(self) -> pb.VIMap:
        """Return the vertices."""
        message = pb.VIMap()
        for row, id_words in enumerate(self._words["vertex.id"]):
            message.vertex_ids.add().words.extend(id_words)
            self._vertex(message.vertices.add(), row)
        return message

    def _members(self, name: str, row: int) -> range:
        start = self._start[name]
        return range(start[row], start[row + 1])

    def _vertex(self, vertex: pb.Vertex, row: int) -> None:
        numbers, ids = self._numbers, self._words
        for edge in self._members("incoming", row):
            vertex.incoming_edges.add().words.extend(ids["incoming.id"][edge])
        for edge in self._members("outgoing", row):
            vertex.outgoing_edges.add().words.extend(ids["outgoing.id"][edge])
        vertex.T_M_I.extend(numbers["vertex.T_M_I"][row])
        vertex.v_M.extend(numbers["vertex.v_M"][row])
        vertex.accel_bias.extend(numbers["vertex.accel_bias"][row])
        vertex.gyro_bias.extend(numbers["vertex.gyro_bias"][row])
        vertex.mission_id.words.extend(ids["vertex.mission_id"][row])
        frames = self._members("frame", row)
        if frames or any(ids["vertex.nframe_id"][row]):
            vertex.nframe.id.words.extend(ids["vertex.nframe_id"][row])
        for frame in frames:
            self._frame(vertex.nframe.frames.add(), frame)
        if any(self._members("resource", frame) for frame in frames):
            for frame in frames:
                self._resources(vertex.frame_resources.add(), frame)
        for landmark in self._members("landmark", row):
            self._landmark(vertex.landmark_store.landmarks.add(), landmark)
        for measurement in self._members("absolute", row):
            self._absolute_pose(vertex.absolute_poses.add(), measurement)
        merge_unknown(vertex, self._columns["vertex.unknown"][row])

    def _frame(self, frame: pb.VisualFrame, row: int) -> None:
        columns, numbers = self._columns, self._numbers
        members = self._members("keypoint", row)
        rows = slice(members.start, members.stop)
        frame.id.words.extend(self._words["frame.id"][row])
        frame.timestamp_ns = numbers["frame.timestamp_ns"][row]
        frame.is_valid = numbers["frame.is_valid"][row]
        frame.keypoints_px.extend(columns["keypoint.uv_px"][rows].reshape(-1).tolist())
        present = numbers["frame.present"][row]
        if present & tables.FrameField.SIGMA:
            frame.sigmas_px.extend(columns["keypoint.sigma_px"][rows].tolist())
        if present & tables.FrameField.SCALE:
            frame.scales.extend(columns["keypoint.scale"][rows].tolist())
        if present & tables.FrameField.TRACK_ID:
            frame.track_ids.extend(columns["keypoint.track_id"][rows].tolist())
        if present & tables.FrameField.POSITION_3D:
            frame.positions_3d.extend(columns["keypoint.position_3d"][rows].reshape(-1).tolist())
        if present & tables.FrameField.TIME_OFFSET:
            offsets = columns["keypoint.time_offset_ns"][rows]
            frame.time_offsets_ns.extend(offsets.reshape(-1).tolist())
        if present & tables.FrameField.LANDMARK_ID or self._observed[row + 1] > self._observed[row]:
            frame.MergeFromString(self._fields["keypoint.landmark_id"].of(rows))
        if (blocks := columns["frame.descriptor_blocks"][row]) is not None:
            layout = numbers["frame.descriptor_layout"][row]
            frame.descriptors = pack(layout, blocks, columns["keypoint.descriptor"][rows])
            if layout == tables.DescriptorLayout.BLOCKS:
                frame.descriptor_types.extend(block.feature_type for block in blocks)
        merge_unknown(frame, columns["frame.unknown"][row])

    def _resources(self, message: pb.FrameResources, frame: int) -> None:
        by_type: dict[int, pb.ResourcesOfType] = {}
        for row in self._members("resource", frame):
            kind = self._numbers["resource.type"][row]
            if kind not in by_type:
                by_type[kind] = message.resources.add(type=kind)
            by_type[kind].resource_ids.add().words.extend(self._words["resource.id"][row])

    def _landmark(self, landmark: pb.Landmark, row: int) -> None:
        numbers = self._numbers
        landmark.id.words.extend(self._words["landmark.id"][row])
        landmark.p_I.extend(numbers["landmark.p_I"][row])
        extend_finite(landmark.covariance, self._columns["landmark.covariance"][row])
        members = self._members("observation", row)
        observations = slice(members.start, members.stop)
        landmark.MergeFromString(self._fields["observation.vertex_id"].of(observations))
        landmark.keypoint_indices.extend(numbers["observation.keypoint_index"][observations])
        landmark.frame_indices.extend(numbers["observation.frame_index"][observations])
        landmark.quality = numbers["landmark.quality"][row]
        landmark.feature_type = numbers["landmark.feature_type"][row]
        merge_unknown(landmark, self._columns["landmark.unknown"][row])

    def _absolute_pose(self, message: Any, row: int) -> None:
        message.timestamp_ns = self._numbers["absolute.timestamp_ns"][row]
        message.sensor_id.words.extend(self._words["absolute.sensor_id"][row])
        message.T_G_S.extend(self._numbers["absolute.T_G_S"][row])
        extend_finite(message.covariance, self._columns["absolute.covariance"][row])
        merge_unknown(message, self._columns["absolute.unknown"][row])
