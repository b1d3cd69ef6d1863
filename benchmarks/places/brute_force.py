"""Pairs of frames that see the same place, by exhaustive search and OpenCV's pose solver.

Nothing of the project's index, voting, pose search or gates takes part: every keypoint of one frame
is compared with every observed landmark of the other, mutual nearest neighbours within a limit of
bits are matches, and a pose from P3P-RANSAC (angles as errors) with enough inliers is a pair.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.loop_closure.features import MapFeatures, map_features
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_BITS = 0.26
"""Part of a descriptor in which a match may differ (the default of lc)."""
INLIER_PX = 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class FramePairs:
    """Verified pairs (N,): the query's pose in the frame of the place's mission."""

    query: I64  # vertex
    place: I64  # vertex
    matches: I64
    inliers: I64
    T_M_I: F64  # (N, 7)

    def __len__(self) -> int:
        return len(self.query)

    def take(self, rows: NDArray[np.bool_]) -> FramePairs:
        """Return some of the pairs."""
        return FramePairs(*(getattr(self, f.name)[rows] for f in dataclasses.fields(self)))

    def T_A_B(self, vi_map: VIMap) -> F64:
        """Return the place (B) as the query (A) sees it (N, 7)."""
        return se3.relative(self.T_M_I, vi_map.vertices.T_M_I[self.place])


def search(
    vi_map: VIMap,
    queries: I64,
    places: I64,
    *,
    min_time_s: float = 10.0,
    min_inliers: int = 12,
    later_only: bool = False,
) -> FramePairs:
    """Compare all queries with all places (vertex rows) that are far enough apart in time.

    With `later_only` a query is compared with earlier places only, so that each pair counts once.
    """
    judged, _ = evaluate_unknown_quality(vi_map)
    features, _ = map_features(judged, np.arange(len(judged.missions)))
    raw = judged.keypoints.descriptor[features.keypoint, : features.kind.size]
    start = np.searchsorted(features.vertex, np.arange(len(judged.vertices) + 1))
    p_G = judged.p_G
    time_s = 1e-9 * judged.vertices.timestamp_ns
    found = []
    for place in places.tolist():
        rows = np.arange(start[place], start[place + 1])
        rows = rows[features.in_database[rows]]
        if len(rows) < min_inliers:
            continue
        T_M_G = se3.inverse(judged.T_G_M[judged.vertices.mission[place]])
        points = se3.transform(T_M_G, p_G[features.descriptors.label[rows]])
        since_s = time_s[queries] - time_s[place]
        apart_s = since_s if later_only else np.abs(since_s)
        for query in queries[apart_s >= min_time_s].tolist():
            mine = np.arange(start[query], start[query + 1])
            i, j = _mutual(raw[mine], raw[rows], round(MAX_BITS * features.kind.dimensions))
            if len(i) < min_inliers:
                continue
            inliers, T_M_I = _pose(features, mine[i], points[j])
            if inliers >= min_inliers:
                found.append((query, place, len(i), inliers, *T_M_I))
    table = np.array(found).reshape(-1, 11)
    whole = table[:, :4].astype(np.int64)
    return FramePairs(whole[:, 0], whole[:, 1], whole[:, 2], whole[:, 3], table[:, 4:])


def _mutual(
    first: NDArray[np.uint8], second: NDArray[np.uint8], max_bits: int
) -> tuple[list[int], list[int]]:
    """Return mutual nearest neighbours of two sets of descriptors."""
    if len(first) == 0 or len(second) == 0:
        return [], []
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(first, second)
    good = [m for m in matches if m.distance <= max_bits]
    return [m.queryIdx for m in good], [m.trainIdx for m in good]


def _pose(features: MapFeatures, rows: I64, point_M: F64) -> tuple[int, F64]:
    """Return the inliers and the pose T_M_I of a single camera from matches with points."""
    # a camera frame whose z axis is the mean ray, so that wide images stay in front of it
    ray_I, origin_I = features.ray_I[rows], features.origin_I[rows[0]]
    z = ray_I.mean(axis=0) / np.linalg.norm(ray_I.mean(axis=0))
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    R_I_C = np.stack([x, np.cross(z, x), z], axis=1)
    ray_C = ray_I @ R_I_C
    front = ray_C[:, 2] > 0.2
    if front.sum() < 6:
        return 0, se3.make(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    ray_C, point_M, rad = ray_C[front], point_M[front], features.rad_per_px[rows[front]]
    plane = ray_C[:, :2] / ray_C[:, 2:]
    cv2.setRNGSeed(1)
    found, turn, shift, _ = cv2.solvePnPRansac(
        point_M, plane, np.eye(3), None, iterationsCount=300, confidence=0.999,
        reprojectionError=float(2.0 * INLIER_PX * np.median(rad)), flags=cv2.SOLVEPNP_P3P,
    )  # fmt: skip
    if not found:
        return 0, se3.make(np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    for _ in range(3):
        inlier = _inliers(turn, shift, point_M, ray_C, rad)
        if inlier.sum() < 6:
            break
        turn, shift = cv2.solvePnPRefineLM(
            point_M[inlier], plane[inlier], np.eye(3), None, turn, shift
        )
    inlier = _inliers(turn, shift, point_M, ray_C, rad)
    T_C_M = se3.make(so3.from_matrix(cv2.Rodrigues(turn)[0]), shift[:, 0])
    T_I_C = se3.make(so3.from_matrix(R_I_C), origin_I)
    return int(inlier.sum()), se3.compose(se3.inverse(T_C_M), se3.inverse(T_I_C))


def _inliers(turn: F64, shift: F64, point_M: F64, ray_C: F64, rad_per_px: F64) -> NDArray[np.bool_]:
    """Tell which points are seen where the pose puts them."""
    direction = point_M @ cv2.Rodrigues(turn)[0].T + shift[:, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sine = np.linalg.norm(np.cross(direction, ray_C), axis=1)
    ahead = np.sum(direction * ray_C, axis=1) > 0.0
    return np.asarray(ahead & (sine < INLIER_PX * rad_per_px))
