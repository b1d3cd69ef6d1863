"""Geometric verification: absolute pose of every query vertex in its candidate places."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.candidates import Candidates, Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures, points_in_mission
from maplab_py.algorithms.loop_closure.record_updates import closure_ids
from maplab_py.array_types import I64
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vision.absolute_pose import PoseProblems, PoseSolutions, solve_poses

_MATCHES_AT_ONCE = 400_000
"""Matches whose rays and points are in memory together, about 200 bytes each."""


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSearch:
    """Estimated poses of candidates (P,), and the inliers (N,) of each."""

    solutions: PoseSolutions  # of all candidates; `is_inlier` is that of the rows here: true
    start: I64  # (P + 1,)
    feature: I64  # (N,) query feature
    landmark: I64  # (N,)
    bits: NDArray[np.int32]  # (N,)


def search_poses(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    *,
    tolerance_px: float,
    seed: int,
    max_iterations: int,
    hypotheses: str,
) -> PoseSearch:
    """Estimate each candidate's pose T_M_I, where M is the frame of the place's mission.

    Candidates are solved in parts, which bounds the memory; none has an influence on another.
    """
    start = candidates.start
    part = start[:-1] // _MATCHES_AT_ONCE
    begins = np.flatnonzero(np.diff(part, prepend=-1))
    cuts = np.append(begins, len(part)) if len(part) else np.zeros(2, dtype=np.int64)
    parts = []
    for begin, end in itertools.pairwise(cuts.tolist()):
        problems, landmark, bits = _problems(
            vi_map, features, matches, candidates, slice(begin, end), tolerance_px
        )
        solutions = solve_poses(
            problems, seed=seed, max_iterations=max_iterations, hypotheses=hypotheses
        )
        parts.append(_inliers(problems, solutions, landmark, bits))
    return _joined(parts)


def _problems(
    vi_map: VIMap,
    features: MapFeatures,
    matches: Matches,
    candidates: Candidates,
    which: slice,
    tolerance_px: float,
) -> tuple[PoseProblems, I64, NDArray[np.int32]]:
    """Return the pose problems of some candidates, and landmark and bits of each row."""
    query, place = candidates.query_vertex[which], candidates.place_vertex[which]
    start = candidates.start[which.start : which.stop + 1]
    match = candidates.match[start[0] : start[-1]]
    problem = np.repeat(np.arange(len(query)), np.diff(start))
    feature = matches.query[match]
    landmark = features.descriptors.label[matches.database[match]]
    bits = matches.bits[match]
    order = np.lexsort((bits, landmark, feature, problem))
    problem, feature = problem[order], feature[order]
    landmark, bits = landmark[order], bits[order]
    mission = vi_map.vertices.mission[place].astype(np.int64)
    problems = PoseProblems(
        start=starts_of_counts(np.bincount(problem, minlength=len(mission))),
        key=closure_ids(vi_map, query, place)[:, 0].view(np.int64),
        q_M_I=vi_map.vertices.T_M_I[query, :4],
        origin_I=features.origin_I[feature],
        ray_I=features.ray_I[feature],
        point_M=points_in_mission(vi_map, landmark, mission[problem]),
        keypoint=feature,
        tolerance=tolerance_px * features.rad_per_px[feature],
    )
    return problems, landmark, bits


def _inliers(
    problems: PoseProblems, solutions: PoseSolutions, landmark: I64, bits: NDArray[np.int32]
) -> PoseSearch:
    """Keep the inliers of solved problems."""
    rows = np.flatnonzero(solutions.is_inlier)
    start = np.searchsorted(rows, problems.start)
    solutions = dataclasses.replace(solutions, is_inlier=solutions.is_inlier[rows])
    return PoseSearch(solutions, start, problems.keypoint[rows], landmark[rows], bits[rows])


def _joined(parts: list[PoseSearch]) -> PoseSearch:
    names = [field.name for field in dataclasses.fields(PoseSolutions)]
    columns = {n: np.concatenate([getattr(part.solutions, n) for part in parts]) for n in names}
    return PoseSearch(
        PoseSolutions(**columns),
        starts_of_counts(np.concatenate([np.diff(part.start) for part in parts])),
        np.concatenate([part.feature for part in parts]),
        np.concatenate([part.landmark for part in parts]),
        np.concatenate([part.bits for part in parts]),
    )
