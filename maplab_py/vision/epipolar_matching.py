"""Match the keypoints of two images of known poses: similar descriptors on epipolar lines."""

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I8, I32, I64, U64
from maplab_py.compilation import compiled, prange
from maplab_py.vision.search_kernels import difference

_NONE = np.iinfo(np.int32).max
_SHORTEST_BASELINE_M = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRays:
    """Keypoints of an image (N), seen from one camera centre."""

    words: U64 | I8  # (N, W) as `DescriptorKind.comparable` makes them
    ray_G: F64  # (N, 3) unit rays
    rad_per_px: F64  # (N,)
    origin_G: F64  # (3,) camera centre [m]


@dataclasses.dataclass(frozen=True)
class EpipolarRule:
    """Conditions that a match must fulfil."""

    gate_px: float  # largest distance from the epipolar line
    min_depth_m: float  # smallest distance of a point, which limits its parallax
    largest_difference: float  # of descriptors, see `DescriptorKind.largest`
    max_ratio: float  # of the differences of the best and the second best keypoint


def match_images(a: ImageRays, b: ImageRays, rule: EpipolarRule) -> tuple[I64, I64, I32]:
    """Return mutually best matches: keypoints of a and of b, and the differences of their descriptors.

    A keypoint of b is a candidate for one of a when it lies near its epipolar line, on the side of
    points ahead, and shows no more parallax than a point at the smallest depth. Both keypoints of a match are
    the most similar candidates of each other, and clearly more similar than the second best.
    """
    baseline = b.origin_G - a.origin_G
    length = float(np.linalg.norm(baseline))
    toward = baseline / length if length > _SHORTEST_BASELINE_M else np.zeros(3)
    normal = np.cross(toward, a.ray_G)
    sine = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(sine, 1e-12)  # zero without a baseline: every line is near
    tolerance = rule.gate_px * np.maximum(a.rad_per_px, 1e-9)
    parallax = np.minimum(tolerance + np.arctan2(length, rule.min_depth_m), np.pi)
    table = np.empty((len(a.ray_G), len(b.ray_G)), dtype=np.int32)
    _fill(a.words, b.words, a.ray_G, b.ray_G, normal, toward, tolerance, np.cos(parallax), table)
    if not table.size:
        none = np.zeros(0, dtype=np.int64)
        return none, none, none.astype(np.int32)
    row, column = np.arange(len(table)), np.argmin(table, axis=1)
    best = table[row, column]
    is_match = (np.argmin(table, axis=0)[column] == row) & (best <= rule.largest_difference)
    row, column, best = row[is_match], column[is_match], best[is_match]
    clear = (best <= rule.max_ratio * _second(table[row], column)) & (
        best <= rule.max_ratio * _second(table[:, column].T, row)
    )
    return row[clear], column[clear], best[clear]


def compile_kernels() -> None:
    """Compile the matching of bits and of signed bytes on one keypoint."""
    rule = EpipolarRule(4.0, 0.3, 1.0, 0.9)
    for dtype in (np.uint64, np.int8):
        words: Any = np.zeros((1, 1), dtype=dtype)
        image = ImageRays(words, np.array([[0.0, 0.0, 1.0]]), np.full(1, 1e-3), np.zeros(3))
        match_images(image, image, rule)


def _second(table: I32, best: I64) -> I32:
    """Return the smallest number of each row (N, K) but for that in the column `best` (N,)."""
    others = np.array(table)
    others[np.arange(len(others)), best] = _NONE
    return np.asarray(others.min(axis=1))


@compiled(parallel=True)
def _fill(words_a, words_b, ray_a, ray_b, normal, toward, tolerance, cosine, table):  # type: ignore[no-untyped-def]
    """Fill in the differences of candidates; all others get the largest number."""
    for i in prange(len(ray_a)):
        for j in range(len(ray_b)):
            off, ahead, same = 0.0, 0.0, 0.0
            for axis in range(3):
                off += normal[i, axis] * ray_b[j, axis]
                ahead += toward[axis] * (ray_b[j, axis] - ray_a[i, axis])
                same += ray_a[i, axis] * ray_b[j, axis]
            if abs(off) > tolerance[i] or ahead > tolerance[i] or same < cosine[i]:
                table[i, j] = _NONE
            else:
                table[i, j] = difference(words_a, i, words_b, j)
