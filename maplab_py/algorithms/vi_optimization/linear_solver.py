"""Choose the linear solver of a map's problem (`--ba_linear_solver_type`, `--ba_max_memory_gb`)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

import numpy as np

from maplab_py.algorithms.vi_optimization.options import SolverFlags
from maplab_py.errors import FlagError
from maplab_py.estimation.linear.ordering import OrderingKind
from maplab_py.estimation.problem.iterative import IterativeOptions, IterativeProblem
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver_choice import SolverCosts, predict_costs
from maplab_py.estimation.problem.submaps import SubmapProblem
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
        FlagError: A number is out of range, or flags contradict each other.
        NotEnoughMemory: The solver does not fit.
    """
    if options.submaps and options.linear_solver_type == "pcg":
        raise FlagError(
            "--ba_submaps factorises: drop --ba_linear_solver_type=pcg, or --ba_submaps"
        )

    def direct() -> Problem:
        with _limited(options):
            return Problem(states, visual, terms, OrderingKind(options.ordering), progress.line)

    def iterative(budget: float = np.inf) -> Problem:
        settings = IterativeOptions(forcing=options.pcg_forcing, budget=budget)
        return IterativeProblem(states, visual, terms, direct, settings, progress.line)

    def in_submaps() -> Problem:
        with _limited(options):
            return SubmapProblem(
                states, visual, terms, options.submaps, OrderingKind(options.ordering), direct,
                progress.line,
            )  # fmt: skip

    obstacle = _obstacle(visual)
    if options.submaps and not obstacle:
        return _with_remedy(in_submaps, remedy=", or take less by a larger --ba_submaps")
    if options.submaps:
        progress.line(f"linear solver: direct, since submaps do not support {obstacle}")
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
