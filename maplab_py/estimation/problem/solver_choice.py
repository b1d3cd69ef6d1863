"""Direct or iterative: predicted from counts, before anything of either solver is set up.

A factorisation is worth `break_even` iterations of conjugate gradients: its predicted time over that
of one iteration. On merged sessions an iterative step takes 1 to 80 iterations, on a single session 70
to 500. The limit between is at 100.

Times per count were measured on two cores of an AMD EPYC; only their ratios matter.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.symbolic import analyse
from maplab_py.estimation.terms.visual import VisualTerms

_FLOPS_PER_S = 45e9  # of a factorisation
_S_PER_PAIR = 24e-9  # of observations of a landmark, in its elimination
_S_PER_OBSERVATION = 20e-9  # of a product with the reduced system
_S_PER_VERTEX = 1.2e-6  # of a solution with the preconditioner
ITERATIVE_FROM = 100.0
"""Iterations that a factorisation must be worth for the iterative solver to be chosen."""
_POSE_SIZE = 6


@dataclasses.dataclass(frozen=True)
class SolverCosts:
    """Predicted costs of both solvers."""

    break_even: float  # iterations that a factorisation is worth
    is_bound: bool  # the factorisation itself was not analysed: break_even is a bound

    @property
    def prefers_iterative(self) -> bool:
        """Whether conjugate gradients are expected to be faster."""
        return self.break_even > ITERATIVE_FROM


def predict_costs(visual: VisualTerms) -> SolverCosts:
    """Predict which solver is faster.

    The pairs of observations and a full matrix of all poses bound the cost of the direct solver from
    below and above. Only where the bounds leave it open the graph of vertices that share landmarks is
    analysed, with nodes of one pose each.

    Raises:
        NotEnoughMemory: The graph does not fit.
    """
    counts = np.diff(visual.observations.start).astype(np.float64)
    pairs_s = _S_PER_PAIR * float(np.sum(counts * (counts + 1.0) / 2.0))
    iteration_s = _S_PER_OBSERVATION * float(counts.sum()) + _S_PER_VERTEX * visual.num_vertices
    lower = pairs_s / iteration_s
    if lower > ITERATIVE_FROM:
        return SolverCosts(lower, is_bound=True)
    full_flops = (_POSE_SIZE * visual.num_vertices) ** 3 / 3.0
    upper = lower + full_flops / _FLOPS_PER_S / iteration_s
    if upper <= ITERATIVE_FROM:
        return SolverCosts(upper, is_bound=True)
    plan = visual.plan
    pattern = BlockPattern.checked(plan.rows, plan.cols, visual.num_vertices, _POSE_SIZE)
    flops = analyse(pattern).statistics.flops
    return SolverCosts(lower + flops / _FLOPS_PER_S / iteration_s, is_bound=False)
