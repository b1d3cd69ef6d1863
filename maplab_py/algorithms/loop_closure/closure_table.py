"""Table of accepted and rejected closures."""

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.geometry import so3
from maplab_py.vimap import Groups, IdArray, LoopClosureEdges, VIMap

VERDICTS = tuple(Verdict)
"""Codes of the `verdict` column are indices into this tuple."""


@dataclasses.dataclass(frozen=True, eq=False)
class GateValues:
    """Verdicts on closures (N) and the values that the gates compare with their thresholds.

    Values of gates that a closure did not reach, or that it does not have, are not-a-number.
    """

    verdict: NDArray[np.int8]  # index into VERDICTS
    matches: I64  # keypoints with a match in the place
    inliers: I64
    tilt_deg: F64
    rotation_sigma_deg: F64  # about the worst axis
    correction_m: F64  # change of the query's position, in G
    correction_deg: F64  # change of the query's attitude
    is_related: Mask  # ends in one mission, or in two whose base frames are known
    between_m: F64  # path between the ends, inside one mission
    rival_share: F64  # inliers of another place / of the best
    rival_stretches: (
        F64  # stretches that only another alignment of the missions explains / only the best
    )
    is_decided: F64  # 1 where an alignment of the missions wins
    follows: F64  # 1 where the closure supports the best alignment
    support: I64  # other query vertices with consistent closures
    difference: F64  # from closures nearby, relative to the tolerances

    @property
    def accepted(self) -> Mask:
        """Mask (N,) of the closures that no gate has rejected."""
        return np.asarray(self.verdict == VERDICTS.index(Verdict.ACCEPTED))


class Closures(GateValues, Groups, items=("keypoint", "landmark", "bits")):
    """Poses of query vertices relative to places; M is the mission frame of the place."""

    id: NDArray[np.uint64]  # (N, 2)
    query_vertex: I64  # (N,)
    place_vertex: I64  # (N,)
    T_M_I: F64  # (N, 7) of the query, as verified
    T_A_B: F64  # (N, 7) pose of the place's vertex (B) in the query (A)
    covariance: F64  # (N, 6, 6) of T_M_I, [dp, dtheta]
    keypoint: I64  # keypoint row of the map, of each inlier match
    landmark: I64  # landmark row
    bits: NDArray[np.int32]  # different bits

    def refused_by_reason(self) -> dict[str, int]:
        """Count the rejected closures by reason."""
        count = np.bincount(self.verdict, minlength=len(VERDICTS))
        return {
            verdict.value: int(n)
            for verdict, n in zip(VERDICTS, count, strict=True)
            if n and verdict is not Verdict.ACCEPTED
        }


_FLOOR_STD = np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002])
"""Common error of the points of a map [m, rad], which the residuals of matches do not show."""


def closure_edges(closures: Closures, options: LoopClosureOptions) -> LoopClosureEdges:
    """Return one edge per accepted closure, from the query vertex (A) to the place's vertex (B).

    Closures with a correction below `edge_min_distance_meters` get no edge.
    """
    enough = closures.correction_m >= options.edge_min_distance_meters
    rows = np.flatnonzero(closures.accepted & enough)
    _, first = np.unique(closures.id[rows], axis=0, return_index=True)
    rows = rows[np.sort(first)]  # two places may have the same best vertex
    return make_edges(
        closures.id[rows],
        (closures.query_vertex[rows], closures.place_vertex[rows]),
        closures.T_M_I[rows],
        closures.T_A_B[rows],
        closures.covariance[rows],
        options,
    )


def make_edges(
    ids: IdArray,
    ends: tuple[I64, I64],
    T_M_A: F64,
    T_A_B: F64,
    covariance: F64,
    options: LoopClosureOptions,
) -> LoopClosureEdges:
    """Return the edges (N) of closures.

    Args:
        ids: Ids (N, 2).
        ends: Query (A) and place (B) vertices (N,).
        T_M_A: Poses (N, 7) of the queries in the missions of the places.
        T_A_B: Poses (N, 7) of the places' vertices in the queries.
        covariance: Covariances (N, 6, 6) of T_M_A, [dp, dtheta].
    """
    relative = _of_relative_pose(covariance, T_M_A, T_A_B) + np.diag(_FLOOR_STD**2)
    return LoopClosureEdges.filled(
        len(ids),
        id=ids,
        from_vertex=ends[0],
        to_vertex=ends[1],
        T_A_B=T_A_B,
        covariance=options.edge_covariance_scaler * relative,
        switch_variable_variance=np.full(len(ids), options.switch_variable_variance),
    )


def _of_relative_pose(covariance: F64, T_M_A: F64, T_A_B: F64) -> F64:
    """Convert the covariance of T_M_A to that of T_A_B = T_M_A^-1 T_M_B with fixed T_M_B.

    With t <- t + dp, R <- R exp(d): p_A_B changes by -R^T dp + [p_A_B]x d, the attitude by -R_B_A d.
    """
    J = np.zeros((len(T_M_A), 6, 6))
    J[:, :3, :3] = -so3.to_matrix(so3.inverse(T_M_A[:, :4]))
    J[:, :3, 3:] = so3.skew(T_A_B[:, 4:])
    J[:, 3:, 3:] = -so3.to_matrix(so3.inverse(T_A_B[:, :4]))
    # errors of neighbouring closures are correlated because they share landmarks
    turned = J @ covariance @ np.swapaxes(J, 1, 2)
    return np.asarray(0.5 * (turned + np.swapaxes(turned, 1, 2)))


def closure_ids(vi_map: VIMap, query_vertex: I64, place_vertex: I64) -> IdArray:
    """Return ids (N, 2) derived from the two vertices: the same closure has the same id."""
    q, p = vi_map.vertices.id[query_vertex], vi_map.vertices.id[place_vertex]
    with np.errstate(over="ignore"):
        mixed = q * np.uint64(0x9E3779B97F4A7C15) + (p ^ (p >> np.uint64(31)))
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = mixed ^ (mixed >> np.uint64(32))
    return np.asarray(mixed | (mixed == 0).astype(np.uint64))
