"""Integer programme of sparsification, solved with HiGHS: exactly, or relaxed and rounded.

Variables: x (L,) in {0, 1}, whether a landmark is kept; u (K, S) >= 0, the cover of a keyframe at
each of S levels. Maximise score^T x + sum of level_value u, subject to sum x = keep and
sum_s u_ks <= (A x)_k, where A holds the weight of a landmark in the rows of keyframes that observe
it. Level values decrease, so the most valuable level fills first. The difference of u to the wanted
cover is the slack of Schneider 2019, eq. 4.2.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.algorithms.sparsification.coverage import CoverageProblem
from maplab_py.algorithms.sparsification.greedy import choose_greedily, exchange
from maplab_py.array_types import F64, Mask
from maplab_py.errors import EstimationError

_GAP = 1e-4
"""Relative gap at which the exact search stops."""
_MAX_NODES = 200
"""Maximum number of nodes of the exact search; unlike a time limit, it is deterministic."""
_INTEGRAL = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """A selection and its objective."""

    chosen: Mask  # (L,)
    objective: float
    bound: float  # upper bound on the objective


def solve_exactly(problem: CoverageProblem) -> Solution:
    """Solve the integer programme by branch and bound, to a relative gap of 1e-4.

    Raises:
        EstimationError: HiGHS gives up.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    p = _programme(problem)
    integral = np.zeros(len(p.cost))
    integral[: problem.landmarks] = 1
    result = milp(
        p.cost,
        integrality=integral,
        bounds=Bounds(np.zeros(len(p.cost)), p.upper),
        constraints=[
            LinearConstraint(p.rows, -np.inf, 0.0),
            LinearConstraint(p.count, problem.keep, problem.keep),
        ],
        options={"mip_rel_gap": _GAP, "node_limit": _MAX_NODES},
    )
    if result.x is None:
        return solve_relaxed(problem)
    chosen = result.x[: problem.landmarks] > 0.5
    return Solution(chosen, problem.objective(chosen), float(-result.mip_dual_bound))


def solve_relaxed(problem: CoverageProblem) -> Solution:
    """Solve the linear relaxation, keep landmarks with x = 1, fill up greedily and exchange.

    A vertex of the relaxation has at most K + 1 fractional x, few in practice, so that the loss by
    rounding is small; the bound measures it.

    Raises:
        EstimationError: HiGHS gives up.
    """
    from scipy.optimize import linprog

    p = _programme(problem)
    bounds = np.stack([np.zeros(len(p.cost)), p.upper], axis=1)
    result = linprog(
        p.cost,
        A_ub=p.rows,
        b_ub=np.zeros(p.rows.shape[0]),
        A_eq=p.count,
        b_eq=[problem.keep],
        bounds=bounds,
        method="highs-ds",
    )
    if result.x is None:
        raise EstimationError(f"landmarks cannot be chosen: {result.message}")
    whole = result.x[: problem.landmarks] > 1.0 - _INTEGRAL
    chosen = exchange(problem, choose_greedily(problem, whole))
    return Solution(chosen, problem.objective(chosen), float(-result.fun))


@dataclasses.dataclass(frozen=True, eq=False)
class _Programme:
    cost: F64  # (L + U,)
    upper: F64  # (L + U,)
    rows: Any  # (K, L + U), each at most 0
    count: Any  # (1, L + U)


def _programme(problem: CoverageProblem) -> _Programme:
    from scipy.sparse import csr_array, dia_array, hstack

    landmarks, keyframes = problem.landmarks, problem.keyframes
    edges = np.linspace(0.0, problem.full, len(problem.level_value) + 1)
    low = np.maximum(edges[None, :-1], problem.base[:, None])
    width = np.minimum(edges[None, 1:], problem.wanted[:, None]) - low
    keyframe, level = np.nonzero(width > 0.0)
    useful = len(keyframe)
    ones = csr_array((np.ones(useful), (keyframe, np.arange(useful))), shape=(keyframes, useful))
    weights = dia_array((problem.weight[None], [0]), shape=(landmarks, landmarks))
    count = np.concatenate([np.ones(landmarks), np.zeros(useful)])
    return _Programme(
        cost=np.concatenate([-problem.score, -problem.level_value[level]]),
        upper=np.concatenate([np.ones(landmarks), width[keyframe, level]]),
        rows=hstack([-(problem.seen @ weights), ones]).tocsc(),
        count=csr_array(count[None]),
    )
