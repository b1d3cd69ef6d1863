"""Loop closure edges of verified closures, with the covariance that verification gives."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F64
from maplab_py.geometry import so3
from maplab_py.vimap import LoopClosureEdges

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
    T_M_A = closures.T_M_I[rows]
    T_A_B = closures.T_A_B[rows]
    covariance = _of_relative_pose(closures.covariance[rows], T_M_A, T_A_B)
    covariance += np.diag(_FLOOR_STD**2)
    return LoopClosureEdges.filled(
        len(rows),
        id=closures.id[rows],
        from_vertex=closures.query_vertex[rows],
        to_vertex=closures.place_vertex[rows],
        T_A_B=T_A_B,
        covariance=options.edge_covariance_scaler * covariance,
        switch_variable_variance=np.full(len(rows), options.switch_variable_variance),
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
