"""Convert vertices with their frames, keypoints and landmarks to messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.descriptor_layout import pack
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vimap.tables import DescriptorLayout, FrameField

Words = list[list[int]]
Groups = tuple[NDArray[np.int64], NDArray[np.int64]]


def _words(ids: NDArray[np.uint64]) -> Words:
    return ids.byteswap().tolist()  # type: ignore[no-any-return]


def _grouped(keys: NDArray[Any], count: int) -> Groups:
    """Return the rows ordered by key, and offsets (count + 1) of the keys' groups."""
    order = np.argsort(keys, kind="stable")
    order = order[np.sort(keys) >= 0]
    return order, starts_of_counts(np.bincount(keys[keys >= 0], minlength=count))


def _members(groups: Groups, key: int) -> list[int]:
    order, start = groups
    return order[start[key] : start[key + 1]].tolist()  # type: ignore[no-any-return]


class VertexWriter:
    """Writes vertices by row; both directions of every link are written."""

    def __init__(self, vi_map: VIMap) -> None:
        """Build the look-up tables of the whole map."""
        self._map = vi_map
        count = len(vi_map.vertices)
        edges = (vi_map.imu_edges, vi_map.transformation_edges, vi_map.loop_closure_edges)
        self._edge_words = _words(np.concatenate([table.id for table in edges]))
        self._incoming = _grouped(np.concatenate([table.to_vertex for table in edges]), count)
        self._outgoing = _grouped(np.concatenate([table.from_vertex for table in edges]), count)
        self._stored = _grouped(vi_map.landmarks.vertex, count)
        self._absolute = _grouped(vi_map.absolute_poses.vertex, count)
        self._vertex_words = _words(vi_map.vertices.id)
        self._nframe_words = _words(vi_map.vertices.nframe_id)
        self._frame_words = _words(vi_map.frames.id)
        self._landmark_words = _words(vi_map.landmarks.id)
        self._mission_words = _words(vi_map.missions.id)
        owner = np.where(
            vi_map.resources.owner_kind == ResourceOwner.FRAME, vi_map.resources.owner, -1
        )
        self._frame_resources = _grouped(owner, len(vi_map.frames))
        self._resource_words = _words(vi_map.resources.id)
        keypoints = vi_map.observations
        frame = vi_map.keypoint_frame[keypoints]
        self._observer = vi_map.frames.vertex[frame].tolist()
        self._observed_keypoint = (keypoints - vi_map.keypoint_start[frame]).tolist()
        self._observed_frame = vi_map.frames.camera_index[frame].tolist()

    def message(self, rows: range) -> pb.VIMap:
        """Return a message with some vertices."""
        message = pb.VIMap()
        for row in rows:
            message.vertex_ids.add().words.extend(self._vertex_words[row])
            self._vertex(message.vertices.add(), row)
        return message

    def _vertex(self, vertex: pb.Vertex, row: int) -> None:
        table = self._map.vertices
        for edge in _members(self._incoming, row):
            vertex.incoming_edges.add().words.extend(self._edge_words[edge])
        for edge in _members(self._outgoing, row):
            vertex.outgoing_edges.add().words.extend(self._edge_words[edge])
        vertex.T_M_I.extend(table.T_M_I[row].tolist())
        vertex.v_M.extend(table.v_M[row].tolist())
        vertex.accel_bias.extend(table.accel_bias[row].tolist())
        vertex.gyro_bias.extend(table.gyro_bias[row].tolist())
        vertex.mission_id.words.extend(self._mission_words[table.mission[row]])
        frames = range(int(self._map.frame_start[row]), int(self._map.frame_start[row + 1]))
        if frames or any(self._nframe_words[row]):
            vertex.nframe.id.words.extend(self._nframe_words[row])
        for frame in frames:
            self._frame(vertex.nframe.frames.add(), frame)
        if any(_members(self._frame_resources, frame) for frame in frames):
            for frame in frames:
                self._resources(vertex.frame_resources.add(), frame)
        for landmark in _members(self._stored, row):
            self._landmark(vertex.landmark_store.landmarks.add(), landmark)
        for measurement in _members(self._absolute, row):
            self._absolute_pose(vertex.absolute_poses.add(), measurement)
        _merge(vertex, table.unknown[row])

    def _frame(self, frame: pb.VisualFrame, row: int) -> None:
        table, keypoints = self._map.frames, self._map.keypoints
        rows = slice(int(self._map.keypoint_start[row]), int(self._map.keypoint_start[row + 1]))
        frame.id.words.extend(self._frame_words[row])
        frame.timestamp_ns = int(table.timestamp_ns[row])
        frame.is_valid = bool(table.is_valid[row])
        frame.keypoints_px.extend(keypoints.uv_px[rows].reshape(-1).tolist())
        present = int(table.present[row])
        if present & FrameField.SIGMA:
            frame.sigmas_px.extend(keypoints.sigma_px[rows].tolist())
        if present & FrameField.SCALE:
            frame.scales.extend(keypoints.scale[rows].tolist())
        if present & FrameField.TRACK_ID:
            frame.track_ids.extend(keypoints.track_id[rows].tolist())
        if present & FrameField.POSITION_3D:
            frame.positions_3d.extend(keypoints.position_3d[rows].reshape(-1).tolist())
        if present & FrameField.TIME_OFFSET:
            frame.time_offsets_ns.extend(keypoints.time_offset_ns[rows].reshape(-1).tolist())
        observed = keypoints.landmark[rows].tolist()
        if present & FrameField.LANDMARK_ID or any(landmark >= 0 for landmark in observed):
            for landmark in observed:
                words = self._landmark_words[landmark] if landmark >= 0 else (0, 0)
                frame.landmark_ids.add().words.extend(words)
        if (blocks := table.descriptor_blocks[row]) is not None:
            layout = int(table.descriptor_layout[row])
            frame.descriptors = pack(layout, blocks, keypoints.descriptor[rows])
            if layout == DescriptorLayout.BLOCKS:
                frame.descriptor_types.extend(block.feature_type for block in blocks)
        _merge(frame, table.unknown[row])

    def _resources(self, message: pb.FrameResources, frame: int) -> None:
        by_type: dict[int, pb.ResourcesOfType] = {}
        for row in _members(self._frame_resources, frame):
            kind = int(self._map.resources.type[row])
            if kind not in by_type:
                by_type[kind] = message.resources.add(type=kind)
            by_type[kind].resource_ids.add().words.extend(self._resource_words[row])

    def _landmark(self, landmark: pb.Landmark, row: int) -> None:
        table = self._map.landmarks
        landmark.id.words.extend(self._landmark_words[row])
        landmark.p_I.extend(table.p_I[row].tolist())
        if np.isfinite(table.covariance[row]).all():
            landmark.covariance.extend(table.covariance[row].reshape(-1).tolist())
        start = self._map.observation_start
        observations = slice(int(start[row]), int(start[row + 1]))
        for vertex in self._observer[observations]:
            landmark.observer_vertex_ids.add().words.extend(self._vertex_words[vertex])
        landmark.keypoint_indices.extend(self._observed_keypoint[observations])
        landmark.frame_indices.extend(self._observed_frame[observations])
        landmark.quality = int(table.quality[row])
        landmark.feature_type = int(table.feature_type[row])
        _merge(landmark, table.unknown[row])

    def _absolute_pose(self, message: pb.AbsolutePose, row: int) -> None:
        table = self._map.absolute_poses
        message.timestamp_ns = int(table.timestamp_ns[row])
        message.sensor_id.words.extend(table.sensor_id[row].byteswap().tolist())
        message.T_G_S.extend(table.T_G_S[row].tolist())
        if np.isfinite(table.covariance[row]).all():
            message.covariance.extend(table.covariance[row].reshape(-1).tolist())
        _merge(message, table.unknown[row])


def _merge(message: Any, unknown: bytes) -> None:
    if unknown:
        message.MergeFromString(unknown)
