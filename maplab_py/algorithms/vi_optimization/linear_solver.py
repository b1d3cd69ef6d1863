"""Choose the linear solver of a map's problem (`--ba_linear_solver_type`, `--ba_max_memory_gb`)."""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from maplab_py.algorithms.vi_optimization.options import SolverFlags
from maplab_py.estimation.linear.ordering import OrderingKind
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.symbolic import analyse
from maplab_py.estimation.problem.iterative import IterativeOptions, IterativeProblem
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.visual import VisualTerms
from maplab_py.memory import NotEnoughMemory, memory_limited, memory_limited_to_share
from maplab_py.progress import Progress

_DEFAULT_SHARE = 0.5
"""Part of the free memory that the direct solver may take where no limit is given."""
_FLAG = "--ba_max_memory_gb"
_REMEDY = ", or take less by --ba_linear_solver_type=pcg"


def make_problem(
    states: States,
    visual: VisualTerms | None,
    terms: Sequence[FactorTerm],
    options: SolverFlags,
    progress: Progress,
) -> Problem:
    """Return the problem with the linear solver of the options; `auto` decides by predicted costs.

    Raises:
        NotEnoughMemory: The solver does not fit.
    """

    def direct() -> Problem:
        with _limited(options):
            return Problem(states, visual, terms, OrderingKind(options.ordering), progress.line)

    def iterative(budget: float = np.inf) -> Problem:
        settings = IterativeOptions(forcing=options.pcg_forcing, budget=budget)
        return IterativeProblem(states, visual, terms, direct, settings, progress.line)

    obstacle = _obstacle(visual)
    if options.linear_solver_type == "pcg":
        if not obstacle:
            return iterative()
        progress.line(f"linear solver: direct, since conjugate gradients do not support {obstacle}")
    if options.linear_solver_type != "auto" or visual is None or obstacle:
        return _with_remedy(direct, remedy="" if obstacle else _REMEDY)
    return _automatic(visual, options, direct, iterative, progress)


def _automatic(
    visual: VisualTerms,
    options: SolverFlags,
    direct: Callable[[], Problem],
    iterative: Callable[..., Problem],
    progress: Progress,
) -> Problem:
    """Return the solver of the smaller predicted costs; the iterative one where no other fits."""
    try:
        with _limited(options):
            costs: SolverCosts | None = predict_costs(visual)
        if costs is not None and not costs.prefers_iterative:
            return direct()
    except NotEnoughMemory:
        costs = None
    visual.forget_plan()
    if costs is None:
        progress.line("linear solver: conjugate gradients, since the direct solver does not fit")
        return iterative()
    at_least = "at least " if costs.is_bound else ""
    progress.line(
        "linear solver: conjugate gradients, since a factorisation would take as long as "
        f"{at_least}{costs.break_even:.0f} iterations"
    )
    if costs.is_bound:
        return iterative()
    return iterative(min(costs.break_even, IterativeOptions().max_iterations))


def _obstacle(visual: VisualTerms | None) -> str:
    """Return what conjugate gradients do not support; empty = nothing."""
    if visual is not None and visual.estimates_cameras:
        return "cameras that are estimated"
    return ""


def _limited(options: SolverFlags) -> contextlib.AbstractContextManager[None]:
    if options.max_memory_gb > 0.0:
        return memory_limited(options.max_memory_gb, _FLAG)
    return memory_limited_to_share(_DEFAULT_SHARE, _FLAG)


def _with_remedy(direct: Callable[[], Problem], remedy: str) -> Problem:
    try:
        return direct()
    except NotEnoughMemory as error:
        raise NotEnoughMemory(f"{error}{remedy}") from None


# Direct or iterative: predicted from counts, before anything of either solver is set up.
#
# A factorisation is worth `break_even` iterations of conjugate gradients: its predicted time over that of
# one iteration. On merged sessions an iterative step takes 1 to 80 iterations, on a single session 70 to
# 500. The limit between is at 100.
#
# Times per count were measured on two cores of an AMD EPYC; only their ratios matter.

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
