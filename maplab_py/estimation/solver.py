"""Levenberg-Marquardt over a `Problem`.

The trust region's radius follows Madsen, Nielsen and Tingleff (Methods for Non-Linear Least
Squares Problems, 2004, section 3.2), as in Ceres: a step whose real decrease is a good part of the
promised one enlarges the radius, a rejected step shrinks it by 2, 4, 8 ... Damping is 1 / radius
times the clamped diagonal of the normal equations.
"""

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


@dataclasses.dataclass(frozen=True)
class SolverSummary:
    """How an optimisation went."""

    initial_costs: dict[str, float]
    final_costs: dict[str, float]
    iterations: int
    rejected_steps: int
    termination: str
    seconds: float


AfterStep = Callable[[int, States], bool]
"""Called after accepted steps with the iteration; True = the problem has changed."""


class _Run:
    """One optimisation under way."""

    def __init__(self, problem: Problem, states: States, options: SolverOptions) -> None:
        self.problem, self.states, self.options = problem, states, options
        self.radius = options.initial_radius
        self.shrink = 2.0
        self.rejected = 0

    def linearize(self) -> Linearization:
        for term in self.problem.factors:
            if isinstance(term, InertialTerm):
                term.integrate(self.states)
        return self.problem.linearize(self.states, 1.0 / self.radius)

    def try_step(self, linear: Linearization) -> tuple[States, float, float, float]:
        """Return the states after one step, their cost, the promised decrease and the step's norm.

        Raises:
            NotPositiveDefinite: The damped system is singular.
        """
        problem, states, damping = self.problem, self.states, 1.0 / self.radius
        step = problem.solve(linear, damping)
        moved = states.moved(step, states.p_G)
        new_cost, promised = 0.0, 0.0
        if problem.visual is not None:
            pose_step = step[:, :2].reshape(-1, 6)
            p_G, new_cost, promised = problem.visual.step(
                states.T_G_I, states.p_G, pose_step, moved.T_G_I, damping
            )
            moved = dataclasses.replace(moved, p_G=p_G)
        flat = step.reshape(-1, 3)
        for nodes, residual, jacobian in linear.factors:
            change = np.einsum("nmk,nk->nm", jacobian, flat[nodes].reshape(len(nodes), -1))
            promised -= float(np.sum(change * (residual + 0.5 * change)))
        new_cost += sum(factor_terms.cost(term, moved) for term in problem.factors)
        norm = float(np.sqrt(np.sum(step**2) + np.sum((moved.p_G - states.p_G) ** 2)))
        return moved, new_cost, promised, norm

    def accept(self, states: States, gain: float) -> None:
        self.states = states
        widen = 1.0 / max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        self.radius = min(self.radius * widen, self.options.max_radius)
        self.shrink = 2.0

    def reject(self) -> None:
        self.radius /= self.shrink
        self.shrink *= 2.0
        self.rejected += 1


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
    run = _Run(problem, states, options)
    with single_blas_thread():
        linear = run.linearize()
        initial = dict(linear.costs)
        if not np.isfinite(linear.cost):
            raise EstimationError(f"the cost is not finite before the first iteration: {initial}")
        termination, iterations = "iteration limit", 0
        for iteration in range(1, options.num_iterations + 1):
            progress.check()
            if time.perf_counter() - began > options.max_time_seconds:
                termination = "time limit"
                break
            if np.abs(problem.projected_gradient(linear)).max() <= options.gradient_tolerance:
                termination = "gradient is zero"
                break
            iterations = iteration
            reason, linear = _iterate(run, linear, iteration, progress, after_step)
            if reason:
                termination = reason
                break
    summary = SolverSummary(
        initial, dict(linear.costs), iterations, run.rejected, termination,
        time.perf_counter() - began,
    )  # fmt: skip
    return run.states, summary


def _iterate(
    run: _Run,
    linear: Linearization,
    iteration: int,
    progress: Progress,
    after_step: AfterStep | None,
) -> tuple[str, Linearization]:
    """Try one step. Return why to stop (empty = go on) and the current linearisation."""
    options, cost = run.options, linear.cost
    try:
        moved, new_cost, promised, norm = run.try_step(linear)
        gain = (cost - new_cost) / promised if promised > 0.0 else -1.0
    except NotPositiveDefinite:
        moved, new_cost, norm, gain = run.states, np.inf, np.inf, -1.0
    progress.line(
        f"{iteration:4d}  cost {cost:14.6e} -> {new_cost:14.6e}  gain {gain:7.3f}  "
        f"step {norm:9.2e}  radius {run.radius:9.2e}"
    )
    if norm <= options.parameter_tolerance * (run.states.size() + options.parameter_tolerance):
        return "step is small", linear
    if not np.isfinite(new_cost) or gain < _SUFFICIENT_GAIN:
        if abs(cost - new_cost) <= options.function_tolerance * cost:
            return "cost has settled", linear
        run.reject()
        if run.radius < options.min_radius:
            return "no step lowers the cost", linear
        return "", run.linearize()  # the elimination of the landmarks depends on the damping
    run.accept(moved, gain)
    changed = after_step is not None and after_step(iteration, run.states)
    linear = run.linearize()
    if not changed and cost - new_cost <= options.function_tolerance * cost:
        return "cost has settled", linear
    return "", linear


def null_projector(direction: F64) -> F64:
    """Return the projectors (N, 3, 3) onto the planes normal to unit directions (N, 3)."""
    return np.asarray(np.eye(3) - direction[:, :, None] * direction[:, None, :])
