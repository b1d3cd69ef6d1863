"""Leave out observations that add little information, where a user limits their number."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.sightings import rays_in_G
from maplab_py.algorithms.vi_optimization.options import DataOptions
from maplab_py.array_types import F64, I64, Mask
from maplab_py.memory import require_memory
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import starts_of_counts

_PRIOR_SIGMA_M = 10.0
"""Standard deviation of a landmark before its first observation."""
_RAD_PER_PX = 2e-3
"""Angle of a pixel of an ordinary camera; only ratios of distances matter for the choice."""
_NEAR_VERTICES = 20
"""Vertices of a mission that are farther apart in it see a place again."""
_BYTES_PER_PAIR = 64


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Number of observations left out by the limits."""

    over_limit: int = 0  # max_observations_per_landmark
    not_covisible: int = 0  # max_covisible_frames


def thinned(vi_map: VIMap, keypoints: I64, options: DataOptions) -> tuple[I64, LeftOut]:
    """Return the observations (keypoint rows) that the limits leave, in order.

    Args:
        vi_map: The map.
        keypoints: Observations (O,), grouped by landmark.
        options: The limits.

    Raises:
        NotEnoughMemory: The pairs of vertices that share landmarks do not fit.
    """
    if not (options.max_observations_per_landmark or options.max_covisible_frames):
        return keypoints, LeftOut()
    from maplab_py.estimation.kernels.observation_choice import Links, Sight, choose

    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    vertex = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    first = np.unique(landmark, return_index=True)[1]
    start = np.append(first, len(keypoints)).astype(np.int64)
    if options.max_covisible_frames:
        links = Links(*_links(vi_map, vertex, landmark, options.max_covisible_frames))
    else:
        none = np.zeros(0, dtype=np.int64)
        links = Links(np.zeros(1, dtype=np.int64), none)
    sight = Sight(start, vertex, *_rays(vi_map, keypoints, landmark))
    chosen = np.zeros(len(keypoints), dtype=np.bool_)
    count = np.zeros(len(vi_map.vertices), dtype=np.int64)
    limit = options.max_observations_per_landmark
    over_limit, not_linked = choose(sight, links, limit, _PRIOR_SIGMA_M**-2, chosen, count)
    return keypoints[chosen], LeftOut(int(over_limit), int(not_linked))


def _rays(vi_map: VIMap, keypoints: I64, landmark: I64) -> tuple[F64, F64]:
    """Return unit rays (O, 3) to the landmarks and the inverse variances (O,) across them."""
    origins, directions, _ = rays_in_G(vi_map, keypoints)
    toward = vi_map.p_G[landmark] - origins
    distance = np.linalg.norm(toward, axis=1)
    is_known = np.isfinite(distance) & (distance > 0.0)
    distance = np.where(is_known, distance, 1.0)
    directions = np.where(is_known[:, None], toward / distance[:, None], directions)
    sigma_px = np.maximum(vi_map.keypoints.sigma_px[keypoints], 1e-3)
    return np.ascontiguousarray(directions), 1.0 / np.square(sigma_px * _RAD_PER_PX * distance)


def _links(vi_map: VIMap, vertex: I64, landmark: I64, limit: int) -> tuple[I64, I64]:
    """Return for each vertex the vertices, at most `limit`, that it may share landmarks with (CSR).

    Pairs are taken by their rank: the pair that shares most landmarks of every two missions, and of
    places seen again in one mission, comes before the second of any; equal ranks by shared landmarks.
    Loops and other missions thus keep their part of the pairs.
    """
    from maplab_py.estimation.kernels.observation_choice import match_vertices

    a, b, shared = _covisible(vi_map, vertex, landmark)
    mission = vi_map.vertices.mission.astype(np.int64)
    is_again = (mission[a] == mission[b]) & (np.abs(a - b) > _NEAR_VERTICES)
    rank = np.maximum(
        _rank(a, 2 * mission[b] + is_again, shared), _rank(b, 2 * mission[a] + is_again, shared)
    )
    order = np.lexsort((b, a, -shared, rank))
    a, b = a[order], b[order]
    kept = np.zeros(len(a), dtype=np.bool_)
    match_vertices(a, b, limit, np.zeros(len(vi_map.vertices), dtype=np.int64), kept)
    ends = np.stack([np.concatenate([a[kept], b[kept]]), np.concatenate([b[kept], a[kept]])])
    ends = ends[:, np.lexsort((ends[1], ends[0]))]
    return starts_of_counts(np.bincount(ends[0], minlength=len(vi_map.vertices))), ends[1]


def _covisible(vi_map: VIMap, vertex: I64, landmark: I64) -> tuple[I64, I64, I64]:
    """Return pairs of vertices (N,), the first the smaller row, and how many landmarks they share."""
    from scipy.sparse import csr_array, triu

    pairs = float(np.sum(np.square(np.bincount(landmark).astype(np.float64))))
    largest = float(len(vi_map.vertices)) ** 2
    require_memory(_BYTES_PER_PAIR * min(pairs, largest), "counting what vertices share")
    shape = (len(vi_map.vertices), len(vi_map.landmarks))
    sees = csr_array((np.ones(len(vertex), dtype=np.int32), (vertex, landmark)), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1
    shared = triu(sees @ sees.T, k=1).tocoo()
    a, b = (index.astype(np.int64) for index in shared.coords)
    return a, b, shared.data.astype(np.int64)


def _rank(vertex: I64, group: I64, shared: I64) -> I64:
    """Return the rank (N,) of each pair among those of its vertex and group, by shared landmarks."""
    order = np.lexsort((-shared, group, vertex))
    begins: Mask = np.ones(len(order), dtype=np.bool_)
    begins[1:] = (np.diff(vertex[order]) != 0) | (np.diff(group[order]) != 0)
    first = np.maximum.accumulate(np.where(begins, np.arange(len(order)), 0))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - first
    return rank
