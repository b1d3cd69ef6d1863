"""Levenberg-Marquardt over a `Problem` (trust region: see `trust_region`)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from maplab_py.errors import EstimationError
from maplab_py.estimation import factor_terms
from maplab_py.estimation.inertial_terms import InertialTerm
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.problem import Linearization, Problem
from maplab_py.estimation.states import F64, States
from maplab_py.estimation.trust_region import Schedule, StepJudge, TrustRegion
from maplab_py.progress import Progress

_SUFFICIENT_GAIN = 1e-3


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """When to stop, and how bold to be."""

    num_iterations: int = 30
    max_time_seconds: float = 1e6
    initial_radius: float = 1e5
    max_radius: float = 1e20
    min_radius: float = 1e-32
    function_tolerance: float = 1e-6
    gradient_tolerance: float = 1e-10
    parameter_tolerance: float = 1e-8
    schedule: Schedule = Schedule.STEP_QUALITY
    max_uphill_steps: int = 0  # consecutive steps that may raise the cost


@dataclasses.dataclass(frozen=True)
class SolverSummary:
    """How an optimisation went."""

    initial_costs: dict[str, float]
    final_costs: dict[str, float]
    iterations: int
    rejected_steps: int
    termination: str
    seconds: float
    singular_at: tuple[int, ...] = ()  # nodes at which a factorisation failed


AfterStep = Callable[[int, States], bool]
"""Called after accepted steps with the iteration; True = the problem has changed."""


class _Run:
    """One optimisation under way."""

    def __init__(self, problem: Problem, states: States, options: SolverOptions) -> None:
        self.problem, self.states, self.options = problem, states, options
        self.region = TrustRegion(
            options.initial_radius, options.min_radius, options.max_radius, options.schedule
        )
        self.linear = self.linearize()
        self.judge = StepJudge(self.linear.cost, options.max_uphill_steps)
        self.best, self.best_cost = states, self.linear.cost
        self.rejected = 0
        self.singular: list[int] = []

    def linearize(self) -> Linearization:
        self.integrated = False
        for term in self.problem.factors:
            if isinstance(term, InertialTerm):
                self.integrated |= term.integrate(self.states)
        return self.problem.linearize(self.states, 1.0 / self.region.radius)

    def try_step(self) -> tuple[States, float, float, float]:
        """Return the states after one step, their cost, the promised decrease and the step's norm.

        Raises:
            NotPositiveDefinite: The damped system is singular.
        """
        problem, states, damping = self.problem, self.states, 1.0 / self.region.radius
        step = problem.solve(self.linear, damping)
        moved = states.moved(step, states.p_G)
        new_cost, promised = 0.0, 0.0
        if problem.visual is not None:
            p_G, new_cost, promised = problem.visual.take_step(states, step, moved, damping)
            moved = dataclasses.replace(moved, p_G=p_G)
        promised += self._promised_by_factors(step)
        new_cost += sum(factor_terms.cost(term, moved) for term in problem.factors)
        norm = float(np.sqrt(np.sum(step**2) + np.sum((moved.p_G - states.p_G) ** 2)))
        return moved, new_cost, promised, norm

    def look_around(self, *, is_last: bool) -> None:
        """Linearise at the present states; after the last step only their cost is wanted."""
        if is_last:
            self.integrated = False
            costs = self.problem.costs(self.states)
            self.linear = dataclasses.replace(self.linear, costs=costs)
        else:
            self.linear = self.linearize()

    def _promised_by_factors(self, step: F64) -> float:
        promised = 0.0
        for nodes, residual, jacobian in self.linear.factors:
            change = np.einsum("nmk,nk->nm", jacobian, step[nodes].reshape(len(nodes), -1))
            promised -= float(np.sum(change * (residual + 0.5 * change)))
        return promised

    def accept(self, states: States, new_cost: float, promised: float, gain: float) -> None:
        self.states = states
        self.region.accept(gain)
        if self.judge.accept(new_cost, promised):
            self.best, self.best_cost = states, new_cost

    def problem_changed(self) -> None:
        """Judge anew: costs before and after the change cannot be compared."""
        self.judge.restart(self.linear.cost)
        self.best, self.best_cost = self.states, self.linear.cost

    def cost_corrected(self, cost_before: float) -> None:
        """Go on from the cost as it is now that edges are integrated anew, earlier ones alike."""
        difference = self.linear.cost - cost_before
        self.judge.shift(difference)
        self.best_cost += difference

    def reject(self) -> None:
        self.region.reject()
        self.rejected += 1

    def return_to_best(self) -> None:
        """Undo uphill steps that led nowhere."""
        if self.best is not self.states and self.best_cost < self.linear.cost:
            self.states = self.best
            self.linear = self.linearize()


def optimize_states(
    problem: Problem,
    states: States,
    options: SolverOptions,
    progress: Progress,
    after_step: AfterStep | None = None,
) -> tuple[States, SolverSummary]:
    """Minimise the problem's cost from the given states.

    Args:
        problem: Terms and restrictions.
        states: Where to begin.
        options: When to stop.
        progress: Shown one line an iteration; cancels between iterations.
        after_step: May exchange weights of the problem (outlier rejection).

    Raises:
        EstimationError: The cost is not finite at the beginning.
    """
    began = time.perf_counter()
    with single_blas_thread():
        run = _Run(problem, states, options)
        initial = dict(run.linear.costs)
        if not np.isfinite(run.linear.cost):
            raise EstimationError(f"the cost is not finite before the first iteration: {initial}")
        termination, iterations = "iteration limit", 0
        for iteration in range(1, options.num_iterations + 1):
            progress.check()
            if time.perf_counter() - began > options.max_time_seconds:
                termination = "time limit"
                break
            if _is_stationary(problem, run.linear, options.gradient_tolerance):
                termination = "gradient is zero"
                break
            iterations = iteration
            if reason := _iterate(run, iteration, progress, after_step):
                termination = reason
                break
        run.return_to_best()
    summary = SolverSummary(
        initial, dict(run.linear.costs), iterations, run.rejected, termination,
        time.perf_counter() - began, tuple(dict.fromkeys(run.singular)),
    )  # fmt: skip
    return run.states, summary


def _is_stationary(problem: Problem, linear: Linearization, tolerance: float) -> bool:
    """Tell whether the gradient is zero; that of landmarks that move is not known."""
    if problem.visual is not None and problem.visual.moves_points:
        return False
    return bool(np.abs(problem.projected_gradient(linear)).max(initial=0.0) <= tolerance)


def _iterate(run: _Run, iteration: int, progress: Progress, after_step: AfterStep | None) -> str:
    """Try one step. Return why to stop; empty = go on."""
    options, cost, radius = run.options, run.linear.cost, run.region.radius
    try:
        moved, new_cost, promised, norm = run.try_step()
        gain = run.judge.gain(new_cost, promised)
    except NotPositiveDefinite as error:
        run.singular.append(error.node)
        moved, new_cost, promised, norm, gain = run.states, np.inf, 0.0, np.inf, -1.0
    progress.line(
        f"{iteration:4d}  cost {cost:14.6e} -> {new_cost:14.6e}  gain {gain:7.3f}  "
        f"step {norm:9.2e}  radius {radius:9.2e}"
    )
    if norm <= options.parameter_tolerance * (run.states.size() + options.parameter_tolerance):
        return "step is small"
    if not np.isfinite(new_cost) or gain < _SUFFICIENT_GAIN:
        if abs(cost - new_cost) <= options.function_tolerance * cost:
            return "cost has settled"
        run.reject()
        if run.region.is_exhausted:
            return "no step lowers the cost"
        run.linear = run.linearize()  # the elimination of the landmarks depends on the damping
        if run.integrated:
            run.cost_corrected(cost)
        return ""
    run.accept(moved, new_cost, promised, gain)
    changed = after_step is not None and after_step(iteration, run.states)
    run.look_around(is_last=iteration == options.num_iterations)
    if changed:
        run.problem_changed()
        return ""
    if run.integrated:
        run.cost_corrected(new_cost)
    if abs(cost - new_cost) <= options.function_tolerance * cost:
        return "cost has settled"
    return ""


def null_projector(direction: F64) -> F64:
    """Return the projectors (N, 3, 3) onto the planes normal to unit directions (N, 3)."""
    return np.asarray(np.eye(3) - direction[:, :, None] * direction[:, None, :])
