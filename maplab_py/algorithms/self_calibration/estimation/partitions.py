"""How the vertices of segments are connected: runs, partitions, gaps, and landmarks' parallax."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.problem.gauge import clusters
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import content_rng
from maplab_py.vimap.ids import random_ids
from maplab_py.vimap.queries import observer_counts
from maplab_py.vimap.selection import keep_rows
from maplab_py.vimap.tables import NO_ROW
from maplab_py.vimap.vertex_removal import move_landmarks

_MAX_DISTANCE_M = 10.0
"""Parallax is computed as if no landmark were farther away."""
_USUAL_QUANTILE = 0.9
"""Parallax is computed as if no landmark were nearer than this quantile of all distances. Landmarks
with little parallax, or seen from poses that have drifted, are estimated too near, and would seem to
have parallax."""


def runs_of(vi_map: VIMap) -> I64:
    """Label the vertices (V,) by runs that inertial edges join, in row order."""
    edges = vi_map.imu_edges
    links = [(edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64))]
    return clusters(len(vi_map.vertices), links)


def partitions(vi_map: VIMap, min_shared_landmarks: int) -> I64:
    """Label the vertices (V,) by partitions, numbered in row order (Schneider 2019, algorithm 4).

    Vertices that inertial edges join belong together, and so do runs that share more landmarks than
    the given number; landmarks of joined runs count together.
    """
    run_of_vertex = runs_of(vi_map)
    count = int(run_of_vertex.max(initial=-1)) + 1
    joined: list[tuple[set[int], set[int]]] = []  # runs and landmarks of each partition
    run_of_observation = run_of_vertex[vi_map.keypoint_vertex[vi_map.observations]]
    landmark = vi_map.keypoints.landmark[vi_map.observations]
    for run in range(count):
        seen = set(landmark[run_of_observation == run].tolist())
        shares = [len(other & seen) > min_shared_landmarks for _, other in joined]
        merged = [group for group, yes in zip(joined, shares, strict=True) if yes]
        joined = [group for group, yes in zip(joined, shares, strict=True) if not yes]
        runs = {run}.union(*(others for others, _ in merged))
        joined.append((runs, seen.union(*(others for _, others in merged))))
    partition_of_run = np.zeros(count, dtype=np.int64)
    for number, (runs, _) in enumerate(sorted(joined, key=lambda group: min(group[0]))):
        partition_of_run[list(runs)] = number
    return np.asarray(partition_of_run[run_of_vertex])


def split_landmarks(vi_map: VIMap, partition: I64) -> VIMap:
    """Give every partition (V,) its own copy of the landmarks that it shares with others.

    Partitions have separate gauges, which a shared landmark would tie together. Copies that fewer
    than two vertices observe are dropped.
    """
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    count = max(int(partition.max(initial=-1)) + 1, 1)
    keys, copy = np.unique(
        landmark * count + partition[vi_map.keypoint_vertex[rows]], return_inverse=True
    )
    copy = np.asarray(copy).reshape(-1)
    if len(keys) == len(vi_map.landmarks):
        return vi_map
    first_vertex = np.zeros(len(keys), dtype=np.int64)
    first_vertex[copy[::-1]] = vi_map.keypoint_vertex[rows][::-1]
    source = keys // count
    table = vi_map.landmarks.take(source)
    new_landmark = np.full(len(vi_map.keypoints), NO_ROW, dtype=np.int32)
    new_landmark[rows] = copy
    is_copy = np.flatnonzero(np.concatenate([[False], source[1:] == source[:-1]]))
    ids = table.id.copy()
    ids[is_copy] = random_ids(len(is_copy), content_rng(vi_map, "partitions"))
    copied = vi_map.replace(
        landmarks=table.replace(id=ids),
        keypoints=vi_map.keypoints.replace(landmark=new_landmark),
    )
    moved = np.flatnonzero(partition[vi_map.landmarks.vertex[source]] != keys % count)
    copied = move_landmarks(copied, moved, first_vertex[moved])
    return keep_rows(copied, landmarks=np.flatnonzero(observer_counts(copied) >= 2))


def parallax_rad(vi_map: VIMap) -> F64:
    """Return the angle (L,) by which the camera moved as seen from each landmark.

    It is the motion across the line of sight over the landmark's distance, which is clamped: from
    below by a quantile of all distances, from above by `_MAX_DISTANCE_M`. Distances of landmarks
    without parallax are noise, and mostly too small (decision 18).
    """
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    centre = vi_map.T_G_I[vi_map.keypoint_vertex[rows], 4:]
    count = np.maximum(np.diff(vi_map.observation_start), 1)
    sums = [np.bincount(landmark, c, minlength=len(count)) for c in centre.T]
    mean = np.stack(sums, axis=1) / count[:, None]
    sight = vi_map.p_G - mean
    distance = np.linalg.norm(sight, axis=1)
    sight /= np.maximum(distance, 1e-9)[:, None]
    offset = centre - mean[landmark]
    along = np.einsum("oi,oi->o", offset, sight[landmark])
    across = np.linalg.norm(offset - along[:, None] * sight[landmark], axis=1)
    widest = np.zeros(len(count))
    np.maximum.at(widest, landmark, across)
    usual = _MAX_DISTANCE_M
    if len(distance):
        usual = min(float(np.quantile(distance, _USUAL_QUANTILE)), _MAX_DISTANCE_M)
    return np.asarray(2.0 * widest / np.clip(distance, max(usual, 0.1), _MAX_DISTANCE_M))


@dataclasses.dataclass(frozen=True, eq=False)
class BiasGaps:
    """Gaps between the segments of a mission, across which the biases walk at random."""

    before: I64  # (G,) vertex rows
    after: I64  # (G,) vertex rows
    duration_s: F64  # (G,)


def bias_gaps(vi_map: VIMap) -> BiasGaps:
    """Return the gaps within missions; there are none between missions.

    An IMU that was switched off has new biases.
    """
    run, mission = runs_of(vi_map), vi_map.vertices.mission
    before = np.flatnonzero((run[1:] != run[:-1]) & (mission[1:] == mission[:-1]))
    time_ns = vi_map.vertices.timestamp_ns
    duration_s = np.asarray((time_ns[before + 1] - time_ns[before]) * 1e-9)
    return BiasGaps(before, before + 1, duration_s)
