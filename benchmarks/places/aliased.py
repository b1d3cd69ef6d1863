"""Rooms that look alike: does anything end up where it does not belong?

Every seed makes a world and three sessions (scenario aliased_rooms), anchors them from a known
mission that changes with the seed, relaxes, closes loops and optimises.
"""

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax_over_loops
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3
from maplab_py.geometry.alignment import align_yaw_position
from maplab_py.simulation.evaluation import Sightings, sightings
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex
from tests.algorithms.loop_closure.against_truth import joined

FAR_M = 0.5
"""A merge of points farther apart is wrong (nearer ones are hard to tell from one point)."""


@dataclasses.dataclass(frozen=True)
class AliasedFigures:
    """What became of one seed's sessions."""

    seed: int
    known: int  # the mission that was known
    anchored: int
    farthest_m: float  # that an anchored mission is off, against the known one
    accepted: int  # closures of the last search
    accepted_wrong: int  # of these, off by 0.5 m or 5 deg
    merges: int  # landmarks joined to another one that are still joined after optvi
    wrong_merges: int  # of these, with a point more than FAR_M away


def measure(seed: int) -> AliasedFigures:
    """Run the workflow on the sessions of one seed."""
    data = simulate(load_scenario("aliased_rooms").with_seed(seed))
    vi_map = joined(data)
    known = seed % len(vi_map.missions)
    flags = np.arange(len(vi_map.baseframes)) == vi_map.missions.baseframe[known]
    vi_map = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=flags))
    anchored, report = anchor_missions(vi_map)
    away_m = farthest_m(anchored, data.truth, known)
    relaxed, _, _ = relax_over_loops(anchored, RelaxationOptions(), LoopClosureOptions())
    closed, _ = close_loops(relaxed)
    accepted, wrong = wrong_closures(closed, data.truth)
    optimised, _ = optimize(closed, VIOptimizationOptions())
    merges, merged_wrong = wrong_merges(optimised, data.truth)
    return AliasedFigures(
        seed, known, len(report.anchored), away_m, accepted, wrong, merges, merged_wrong
    )


def farthest_m(vi_map: VIMap, truth: Truth, known: int) -> float:
    """Return how far the middle of an anchored mission is from its place beside the known one."""
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    own = vi_map.vertices.mission == known
    T_true_G = align_yaw_position(truth.T_G_I[row[own], 4:], vi_map.T_G_I[own, 4:])
    farthest = 0.0
    for mission in np.flatnonzero(vi_map.baseframes.is_known[vi_map.missions.baseframe]):
        mine = vi_map.vertices.mission == mission
        p_true, p_G = truth.T_G_I[row[mine], 4:], vi_map.T_G_I[mine, 4:]
        middle = p_G.mean(axis=0)
        gap = se3.transform(align_yaw_position(p_true, p_G), middle) - se3.transform(
            T_true_G, middle
        )
        farthest = max(farthest, float(np.linalg.norm(gap)))
    return farthest


def wrong_closures(vi_map: VIMap, truth: Truth) -> tuple[int, int]:
    """Count the accepted closures of the map's record, and those of them that are not true."""
    closures = read_record(vi_map).closures
    closures = closures.take(closures.verdict == VERDICTS.index(Verdict.ACCEPTED))
    index = IdIndex(truth.vertex_id)
    a, b = index.rows(closures.query), index.rows(closures.place)
    error = se3.local(se3.relative(truth.T_G_I[a], truth.T_G_I[b]), closures.T_A_B)
    far = np.linalg.norm(error[:, :3], axis=1) > 0.5
    turned = np.linalg.norm(error[:, 3:], axis=1) > np.deg2rad(5.0)
    return len(closures), int(np.count_nonzero(far | turned))


def wrong_merges(vi_map: VIMap, truth: Truth) -> tuple[int, int]:
    """Count tracks that were joined to others, and those joined to a point far from theirs.

    Of a landmark's tracks those of the most frequent point are right together.
    """
    seen = sightings(vi_map, truth)
    known = seen.track >= 0
    pairs = np.unique(np.stack([seen.landmark[known], seen.track[known]], axis=1), axis=0)
    landmark, point = pairs[:, 0], truth.landmark_point[pairs[:, 1]]
    groups, size = np.unique(np.stack([landmark, point], axis=1), axis=0, return_counts=True)
    order = np.lexsort((groups[:, 1], -size, groups[:, 0]))
    owner, first = np.unique(groups[order, 0], return_index=True)
    main = groups[order[first], 1]
    apart = truth.point_G[point] - truth.point_G[main[np.searchsorted(owner, landmark)]]
    merges = len(pairs) - len(owner)
    return merges, int(np.count_nonzero(np.linalg.norm(apart, axis=1) > FAR_M))


def merges_of_strangers(vi_map: VIMap, truth: Truth) -> int:
    """Count the tracks that were merged although they show other points than the rest of their landmark.

    A simulated tracker sometimes goes over from one point to another one. Such a track shows both, and
    is merged rightly with tracks of either, while `wrong_merges` compares the point that it showed most
    often before keyframing.
    """
    return strangers(sightings(vi_map, truth), truth.point_G)


def strangers(seen: Sightings, point_G: F64) -> int:
    """Count the tracks outside the largest group of each landmark.

    Two tracks of a landmark belong to one group if they show the same point or points nearer than
    FAR_M, or if other tracks of the landmark join them in this way.

    Args:
        seen: Observations of the map.
        point_G: World points (P, 3).
    """
    real = (seen.track >= 0) & (seen.point >= 0)
    landmark, track, point = seen.landmark[real], seen.track[real], seen.point[real]
    tracks, of_track = np.unique(np.stack([landmark, track], axis=1), axis=0, return_inverse=True)
    shown, of_point = np.unique(np.stack([landmark, point], axis=1), axis=0, return_inverse=True)
    a, b = _near(shown, point_G)
    ends = np.append(of_track, len(tracks) + a), len(tracks) + np.append(of_point, b)
    nodes = len(tracks) + len(shown)
    joined_by = coo_array((np.ones(len(ends[0])), ends), shape=(nodes, nodes))
    group = connected_components(joined_by, directed=False)[1][: len(tracks)]
    groups, size = np.unique(np.stack([tracks[:, 0], group], axis=1), axis=0, return_counts=True)
    begins = np.flatnonzero(np.diff(groups[:, 0], prepend=-1))
    return int(len(tracks) - np.maximum.reduceat(size, begins).sum()) if len(size) else 0


def _near(shown: I64, point_G: F64) -> tuple[I64, I64]:
    """Return the pairs of rows of (landmark, point) (N, 2), sorted, of near points of one landmark."""
    begins = np.flatnonzero(np.diff(shown[:, 0], prepend=-1))
    count = np.diff(np.append(begins, len(shown)))
    after = np.repeat(begins + count, count) - np.arange(len(shown)) - 1  # rows of the landmark
    a = np.repeat(np.arange(len(shown)), after)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(after) - after, after)
    near = np.linalg.norm(point_G[shown[a, 1]] - point_G[shown[b, 1]], axis=1) <= FAR_M
    return a[near], b[near]
