"""Columns of the files of vertices: all that vertices say, with their frames, keypoints and landmarks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.storage.file_contents import Columns, Groups
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.table import Table, ragged_rows

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
        self._incoming = Groups.of(np.concatenate([table.to_vertex for table in edges]), count)
        self._outgoing = Groups.of(np.concatenate([table.from_vertex for table in edges]), count)
        self._stored = Groups.of(vi_map.landmarks.vertex, count)
        self._absolute = Groups.of(vi_map.absolute_poses.vertex, count)
        resources = vi_map.resources
        owner = np.where(resources.owner_kind == ResourceOwner.FRAME, resources.owner, -1)
        self._resources = Groups.of(owner, len(vi_map.frames))

    def of(self, rows: range) -> Columns:
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


def _part(prefix: str, table: Table, names: tuple[str, ...], rows: Any) -> dict[str, NDArray[Any]]:
    return {f"{prefix}.{name}": getattr(table, name)[rows] for name in names}


def _ids_or_zero(ids: NDArray[np.uint64], rows: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the ids (N, 2) of rows; zero for negative ones."""
    result = np.zeros((len(rows), 2), dtype=np.uint64)
    known = rows >= 0
    result[known] = ids[rows[known]]
    return result
