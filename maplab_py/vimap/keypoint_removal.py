"""Remove keypoints of frames."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import Mask
from maplab_py.vimap.edits import remove_landmarks
from maplab_py.vimap.table import object_column
from maplab_py.vimap.vi_map import VIMap


def remove_keypoints(vi_map: VIMap, removed: Mask) -> VIMap:
    """Return the map without some keypoints (K,) and their descriptors.

    Landmarks that lose their last observation are removed. Blocks that lose all keypoints are, too.
    """
    if not removed.any():
        return vi_map
    frames, keypoints = vi_map.frames, vi_map.keypoints
    before = np.concatenate([[0], np.cumsum(removed)])  # removed ones before each keypoint
    blocks = list(frames.descriptor_blocks)
    lost = np.diff(before[vi_map.keypoint_start])
    for row in np.flatnonzero(lost).tolist():
        end, kept = int(vi_map.keypoint_start[row]), []
        for block in blocks[row] or ():
            begin, end = end, end + block.keypoints
            count = block.keypoints - int(before[end] - before[begin])
            if count:
                kept.append(block._replace(keypoints=count))
        blocks[row] = tuple(kept) if blocks[row] is not None else None
    size = len(vi_map.landmarks)
    left = keypoints.landmark[~removed]
    observed = np.bincount(keypoints.landmark[keypoints.landmark >= 0], minlength=size)
    still = np.bincount(left[left >= 0], minlength=size)
    reduced = vi_map.replace(
        frames=frames.replace(
            keypoint_count=frames.keypoint_count - lost, descriptor_blocks=object_column(blocks)
        ),
        keypoints=keypoints.take(np.flatnonzero(~removed)),
    )
    return remove_landmarks(reduced, (observed > 0) & (still == 0))
