"""Geometric verification: absolute pose of every query vertex in its candidate places."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.candidates import Candidates, Matches
from maplab_py.algorithms.loop_closure.features import MapFeatures, points_in_mission
from maplab_py.algorithms.loop_closure.record_updates import closure_ids
from maplab_py.array_types import I64
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import starts_of_counts
from maplab_py.vision.absolute_pose import PoseProblems, PoseSolutions, solve_poses


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSearch:
    """Pose problems and solutions, and the match of each row of a problem."""

    solutions: PoseSolutions
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
    """Estimate each candidate's pose T_M_I, where M is the frame of the place's mission."""
    problem = np.repeat(np.arange(len(candidates.query_vertex)), np.diff(candidates.start))
    feature = matches.query[candidates.match]
    landmark = features.descriptors.label[matches.database[candidates.match]]
    bits = matches.bits[candidates.match]
    order = np.lexsort((bits, landmark, feature, problem))
    problem, feature = problem[order], feature[order]
    landmark, bits = landmark[order], bits[order]
    mission = vi_map.vertices.mission[candidates.place_vertex].astype(np.int64)
    problems = PoseProblems(
        start=starts_of_counts(np.bincount(problem, minlength=len(mission))),
        key=closure_ids(vi_map, candidates.query_vertex, candidates.place_vertex)[:, 0].view(
            np.int64
        ),
        q_M_I=vi_map.vertices.T_M_I[candidates.query_vertex, :4],
        origin_I=features.origin_I[feature],
        ray_I=features.ray_I[feature],
        point_M=points_in_mission(vi_map, landmark, mission[problem]),
        keypoint=feature,
        tolerance=tolerance_px * features.rad_per_px[feature],
    )
    solutions = solve_poses(
        problems, seed=seed, max_iterations=max_iterations, hypotheses=hypotheses
    )
    return PoseSearch(solutions, problems.start, feature, landmark, bits)
