"""First observations of landmarks."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import I64
from maplab_py.vimap import VIMap


def first_observation(vi_map: VIMap) -> I64:
    """Return the first observing keypoint row (L,) of each landmark in its mission, else any; or -1."""
    keypoint = vi_map.observations
    landmark = vi_map.keypoints.landmark[keypoint]
    home = vi_map.vertices.mission[vi_map.landmarks.vertex]
    is_foreign = vi_map.vertices.mission[vi_map.keypoint_vertex[keypoint]] != home[landmark]
    order = np.lexsort((keypoint, is_foreign, landmark))[::-1]
    first = np.full(len(vi_map.landmarks), -1, dtype=np.int64)
    first[landmark[order]] = keypoint[order]
    return first


def first_observer(vi_map: VIMap) -> I64:
    """Return the first observing vertex row (L,) of each landmark in its mission, else any; or -1."""
    first = first_observation(vi_map)
    vertex = np.full(len(first), -1, dtype=np.int64)
    vertex[first >= 0] = vi_map.keypoint_vertex[first[first >= 0]]
    return vertex


def first_camera(vi_map: VIMap) -> I64:
    """Return the index (L,) of the camera that observed each landmark first, -1 where none did."""
    first = first_observation(vi_map)
    camera = np.full(len(first), -1, dtype=np.int64)
    camera[first >= 0] = vi_map.frames.camera_index[vi_map.keypoint_frame[first[first >= 0]]]
    return camera
