"""Consistency of closures: neighbours along the trajectory must agree in yaw and position.

A closure of a query in mission A with a place in mission B determines T_B_A. Two closures of the
same pair of missions agree if both give the same position of a query, up to the drift between the
queries and between the places (Mangelson 2018: pairwise consistency, here restricted
to neighbours).
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, yaw
from maplab_py.vimap import VIMap

_WINDOW = 60
"""Number of closures before and after each closure, by arc length, that it is compared with."""
_REACH_M = 15.0
"""Maximum arc length between compared closures."""
_NEAR_M = 3.0
"""Arc length within which closures that disagree contradict each other."""
_MOST_PAIRS = 1_000_000
"""Pairs of closures that are compared at once, for the memory."""


_TOLERANCE_M, _TOLERANCE_RAD = 0.15, 0.025
_DRIFT_RATIO, _DRIFT_RAD_PER_M = 0.02, 4e-4
"""Drift per arc length between the queries plus that between the places."""
_LONE_INLIERS = 50
"""Required inliers of a closure without neighbours."""


def path_lengths(vi_map: VIMap) -> F64:
    """Return the arc length (V,) [m] of each vertex along its mission."""
    p, mission = vi_map.vertices.T_M_I[:, 4:], vi_map.vertices.mission
    step = np.zeros(len(p))
    step[1:] = np.linalg.norm(np.diff(p, axis=0), axis=1) * (mission[1:] == mission[:-1])
    total = np.cumsum(step)
    first = vi_map.vertex_start[:-1][mission] if len(p) else np.zeros(0, dtype=np.int64)
    return np.asarray(total - total[first])


def check_consensus(
    vi_map: VIMap,
    query_vertex: I64,
    place_vertex: I64,
    T_M_I: F64,
    inliers: I64,
    max_difference: float = 1.0,
) -> tuple[I64, F64]:
    """Return the query vertices (N,) that support closures, and the differences (N,) from neighbours.

    A closure whose difference reaches `max_difference`, a factor on the tolerances, is contradicted.
    Closures that need no support, because they have many inliers and no neighbours, have not-a-number.
    """
    mission = vi_map.vertices.mission
    pair = mission[query_vertex].astype(np.int64) * len(vi_map.missions) + mission[place_vertex]
    way = path_lengths(vi_map)
    order = np.lexsort((place_vertex, way[query_vertex], pair))
    T_A_I = vi_map.vertices.T_M_I[query_vertex]
    parts = [
        _compare(i, j, pair, way, query_vertex, place_vertex, T_A_I, T_M_I)
        for i, j in _neighbours(order)
    ]
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    by_difference = np.lexsort((columns[2], columns[0]))
    compared = _Compared(*(column[by_difference] for column in columns))
    alive = np.ones(len(query_vertex), dtype=np.bool_)
    # a wrong closure may contradict correct ones: test twice, the second time with survivors only
    for _ in range(2):
        support, difference, is_alone = compared.votes(inliers, alive, max_difference)
        alive = alive & ~(difference >= max_difference) & (support > 0)
    lone = is_alone & (inliers >= _LONE_INLIERS)
    return support, np.where(lone, np.nan, difference)


@dataclasses.dataclass(frozen=True, eq=False)
class _Compared:
    """Pairs (P,) of neighbouring closures, ordered by i and difference: j judges i."""

    i: I64
    j: I64
    difference: F64  # relative to the tolerances; below `max_difference` the two agree
    is_near: Mask  # so near by that drift cannot be the reason of a disagreement
    is_other: Mask  # of another query vertex

    def votes(self, inliers: I64, alive: Mask, max_difference: float) -> tuple[I64, F64, Mask]:
        """Return support by distinct query vertices, differences, and closures that no other one tests.

        The difference of a closure is the smallest one beyond which the inliers that contradict it are
        not more than its own and those that agree.
        """
        count, here = len(inliers), alive[self.j]
        i, weight, difference = self.i[here], inliers[self.j[here]] * 1.0, self.difference[here]
        agrees, near = difference < max_difference, weight * self.is_near[here]
        supporting = i[agrees & self.is_other[here]]
        support = np.bincount(supporting, minlength=count).astype(np.int64)
        against = np.bincount(i, near * ~agrees, minlength=count)
        left = inliers - np.bincount(i, near, minlength=count)  # if nobody agreed
        gained = np.append(0.0, np.cumsum(weight + near))
        enough = left[i] + gained[1:] - gained[np.searchsorted(i, i)] >= 0.0
        smallest = np.where(left >= 0.0, 0.0, np.inf)
        np.minimum.at(smallest, i[enough], difference[enough])
        return support, smallest, (support == 0) & (against == 0.0)


def _neighbours(order: I64) -> Iterator[tuple[I64, I64]]:
    """Yield pairs of closures at most `_WINDOW` apart in the order, both ways round, in pieces."""
    steps = range(1, min(_WINDOW, len(order) - 1) + 1)
    size = max(_MOST_PAIRS // max(len(order), 1), 1)
    for first in range(0, max(len(steps), 1), size):
        piece = steps[first : first + size]
        earlier = np.concatenate([order[:0], *(order[:-step] for step in piece)])
        later = np.concatenate([order[:0], *(order[step:] for step in piece)])
        yield np.concatenate([earlier, later]), np.concatenate([later, earlier])


def _compare(
    i: I64,
    j: I64,
    pair: I64,
    way: F64,
    query: I64,
    place: I64,
    T_A_I: F64,
    T_B_I: F64,
) -> tuple[I64, I64, F64, Mask, Mask]:
    """Return the columns of `_Compared` for those of some pairs that are near each other."""
    between = np.abs(way[query[i]] - way[query[j]])
    near = (pair[i] == pair[j]) & (between < _REACH_M)
    i, j, between = i[near], j[near], between[near]
    E = yaw.from_pose(se3.compose(T_B_I, se3.inverse(T_A_I)))  # frame A in frame B
    between_places = np.abs(way[place[i]] - way[place[j]])
    both_ways = between + np.minimum(between_places, between + _REACH_M)
    largest_m = _TOLERANCE_M + _DRIFT_RATIO * both_ways
    largest_rad = _TOLERANCE_RAD + _DRIFT_RAD_PER_M * both_ways
    # position of query i implied by closure j
    apart_m = np.linalg.norm(yaw.transform(E[j], T_A_I[i, 4:]) - T_B_I[i, 4:], axis=1)
    turn_rad = np.abs(yaw.wrap(E[i, 3] - E[j, 3]))
    difference = np.maximum(apart_m / largest_m, turn_rad / largest_rad)
    difference[np.isnan(difference)] = np.inf
    return i, j, difference, between < _NEAR_M, query[i] != query[j]
