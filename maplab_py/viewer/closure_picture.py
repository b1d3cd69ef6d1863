"""The images of both ends of a loop closure side by side, with their matches."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.viewer.vertex_images import VertexImages
from maplab_py.vimap import VIMap
from maplab_py.vimap.descriptors import binary_descriptor_sizes

_MAX_BIT_FRACTION = 0.2
"""Bits in which the descriptors of a match may differ, as a part of all."""
_COLOUR = (255, 153, 0)
_GAP_PX = 6


@dataclasses.dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of two images that show the same point."""

    first: I64  # (N,) rows
    second: I64  # (N,)
    are_landmarks: bool  # both observe one landmark; else their descriptors are alike

    def __len__(self) -> int:
        return len(self.first)

    @property
    def note(self) -> str:
        """Meaning of the lines between both images."""
        what = "landmarks in common" if self.are_landmarks else "pairs of similar descriptors"
        return f"{len(self)} {what} in these images"


def closure_picture(
    vi_map: VIMap, images: VertexImages, query: int, place: int
) -> tuple[U8, str] | None:
    """Return a picture (H, W, 3) RGB of two vertices (rows) with their matches, and what it shows.

    Args:
        vi_map: The map.
        images: Its images.
        query: Vertex at the left.
        place: Vertex at the right.

    Returns:
        None if the map has not both images.
    """
    left, right = images.image(query), images.image(place)
    frames = images.frame(query), images.frame(place)
    if left is None or right is None:
        return None
    matches = matches_of_frames(vi_map, *frames)
    height = max(left.shape[0], right.shape[0])
    offset = left.shape[1] + _GAP_PX
    canvas = np.full((height, offset + right.shape[1], 3), 255, dtype=np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[: right.shape[0], offset:] = right
    start = vi_map.keypoints.uv_px[matches.first]
    end = vi_map.keypoints.uv_px[matches.second] + [offset, 0.0]
    _draw(canvas, start, end)
    return canvas, matches.note


def matches_of_frames(vi_map: VIMap, first: int, second: int) -> Matches:
    """Return the keypoints of two frames (rows) that observe one landmark.

    Closures that are refused merge no landmarks. If both frames have none in common, these are the
    keypoints whose descriptors are mutually nearest and similar.
    """
    a, b = (
        np.arange(*vi_map.keypoint_start[frame : frame + 2], dtype=np.int64)
        for frame in (first, second)
    )
    landmark = vi_map.keypoints.landmark
    a_seen, b_seen = a[landmark[a] >= 0], b[landmark[b] >= 0]
    _, rows_a, rows_b = np.intersect1d(landmark[a_seen], landmark[b_seen], return_indices=True)
    if len(rows_a):
        return Matches(a_seen[rows_a], b_seen[rows_b], are_landmarks=True)
    sizes = binary_descriptor_sizes(vi_map.frames)
    size = int(sizes[a].max(initial=0))
    a, b = a[sizes[a] == size], b[sizes[b] == size]
    if not size or not len(a) or not len(b):
        return Matches(a[:0], b[:0], are_landmarks=True)
    words = (np.ascontiguousarray(vi_map.keypoints.descriptor[rows, :size]) for rows in (a, b))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(*words)
    table = np.array([(m.queryIdx, m.trainIdx, m.distance) for m in pairs]).reshape(-1, 3)
    near = table[table[:, 2] <= _MAX_BIT_FRACTION * 8 * size].astype(np.int64)
    return Matches(a[near[:, 0]], b[near[:, 1]], are_landmarks=False)


def _draw(canvas: U8, start: F64, end: F64) -> None:
    """Draw lines between points (N, 2) [px] and dots at their ends."""
    width = max(1, round(canvas.shape[1] / 900))
    ends = np.round(np.stack([start, end], axis=1)).astype(np.int32)
    cv2.polylines(canvas, list(ends), isClosed=False, color=_COLOUR, thickness=width)
    for x, y in ends.reshape(-1, 2).tolist():
        cv2.circle(canvas, (x, y), 3 * width, _COLOUR, width)
