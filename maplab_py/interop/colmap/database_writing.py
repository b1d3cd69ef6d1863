"""Keypoints, descriptors and matches of a map, as the job `database` of the child takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64
from maplab_py.interop.colmap.from_map import ExportedModel
from maplab_py.interop.colmap.model import NO_POINT
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType
from maplab_py.vimap.table import starts_of_counts

_MAX_GAP = 50
"""Pairs of images are matched up to this many observations of a landmark apart."""
_MIN_MATCHES = 15
"""COLMAP's least number of inliers of a pair."""


def database_arrays(vi_map: VIMap, exported: ExportedModel) -> dict[str, NDArray[Any]]:
    """Return the columns of the database by name.

    Keypoints are float32 as COLMAP stores them: x, y, scale, orientation (0).
    """
    images = exported.model.images
    keypoints = np.zeros((len(images.uv), 4), dtype=np.float32)
    keypoints[:, :2] = images.uv
    scale = vi_map.keypoints.scale[exported.keypoints]
    keypoints[:, 2] = np.where(scale > 0.0, scale, 1.0)
    size, is_sift = _descriptor_sizes(vi_map, exported.frames)
    pairs, start, matches = matches_of_landmarks(exported)
    return {
        "images": images.id,
        "keypoint_start": images.keypoint_start,
        "keypoints": keypoints,
        "descriptors": vi_map.keypoints.descriptor[exported.keypoints],
        "descriptor_bytes": size,
        "is_sift": is_sift,
        "pairs": pairs,
        "match_start": start,
        "matches": matches,
    }


def _descriptor_sizes(vi_map: VIMap, frames: I64) -> tuple[I64, NDArray[np.bool_]]:
    """Return the bytes (N,) of each frame's descriptors, and whether they are SIFT.

    COLMAP has one kind of descriptor in an image; frames with several get 0.
    """
    blocks = vi_map.frames.descriptor_blocks[frames]
    kinds = [{block[1:] for block in of_frame or () if block.keypoints} for of_frame in blocks]
    single = [next(iter(kind)) if len(kind) == 1 else (0, 0, 0) for kind in kinds]
    size = np.array([entry[0] for entry in single], dtype=np.int64)
    sift = (DescriptorDepth.UINT8, FeatureType.SIFT)
    return size, np.array([entry[1:] == sift for entry in single], dtype=np.bool_)


def matches_of_landmarks(exported: ExportedModel) -> tuple[I64, I64, NDArray[np.uint32]]:
    """Return pairs of image ids (P, 2), offsets (P + 1,), and matched keypoints (sum, 2).

    Two images match in the keypoints that observe the same landmark; pairs with few matches are left
    out.
    """
    images = exported.model.images
    observing = np.flatnonzero(images.point != NO_POINT)
    observing = observing[np.argsort(images.point[observing], kind="stable")]
    point, image = images.point[observing], images.keypoint_image[observing]
    keypoint = observing - images.keypoint_start[image]
    parts = []
    for gap in range(1, _MAX_GAP + 1):
        a = np.flatnonzero(point[gap:] == point[:-gap])
        if not len(a):
            break
        a = a[image[a] != image[a + gap]]
        ends = np.stack([image[a], image[a + gap], keypoint[a], keypoint[a + gap]], axis=1)
        parts.append(ends)
    table = np.concatenate(parts) if parts else np.zeros((0, 4), dtype=np.int64)
    table = table[np.lexsort((table[:, 3], table[:, 2], table[:, 1], table[:, 0]))]
    pairs, count = np.unique(table[:, :2], axis=0, return_counts=True)
    kept = count >= _MIN_MATCHES
    table = table[np.repeat(kept, count)]
    return images.id[pairs[kept]], starts_of_counts(count[kept]), table[:, 2:].astype(np.uint32)
