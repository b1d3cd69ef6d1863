"""Levenberg-Marquardt over a `protocol.LeastSquares` problem (trust region: see `trust_region`)."""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Generator
from typing import Generic

import numpy as np

from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import protocol, threads
from maplab_py.estimation.problem import trust_region
from maplab_py.estimation.problem.protocol import L, LeastSquares, S, Step
from maplab_py.estimation.states import States
from maplab_py.progress import Progress

SLOW_CONVERGENCE = "convergence is slow"
_SUFFICIENT_GAIN = 1e-3
_RECENT_STEPS = 10


@dataclasses.dataclass(frozen=True)
class SolverOptions:
    """Convergence criteria, and settings of the trust region."""

    num_iterations: int = 30
    max_time_seconds: float = 1e6
    initial_radius: float = 1e5
    max_radius: float = 1e20
    min_radius: float = 1e-32
    function_tolerance: float = 1e-6
    gradient_tolerance: float = 1e-10
    parameter_tolerance: float = 1e-8
    forecast_tolerance: float = 0.0  # share of the cost that all further steps may save
    slow_ratio: float = 1.0  # stop when decreases shrink by no more than that; 1 = go on
    schedule: trust_region.Schedule = trust_region.Schedule.STEP_QUALITY
    max_uphill_steps: int = 0  # consecutive steps that may raise the cost


@dataclasses.dataclass(frozen=True)
class SolverSummary:
    """Course of an optimisation."""

    initial_costs: dict[str, float]
    final_costs: dict[str, float]
    iterations: int
    rejected_steps: int
    termination: str
    seconds: float
    singular_at: tuple[int, ...] = ()  # nodes at which a factorisation failed
    recent_decrease: float = 0.0  # of the cost in the last ten accepted steps
    radius: float = 0.0  # of the trust region at the end


AfterStep = Callable[[int, States], bool]
"""Called after accepted steps with the iteration; True = the problem has changed."""


class _Run(Generic[S, L]):
    """One optimisation under way."""

    def __init__(self, problem: LeastSquares[S, L], states: S, options: SolverOptions) -> None:
        self.problem, self.states, self.options = problem, states, options
        self.region = trust_region.TrustRegion(
            options.initial_radius, options.min_radius, options.max_radius, options.schedule
        )
        self.decreases = trust_region.Decreases()
        self.recent: deque[float] = deque(maxlen=_RECENT_STEPS)
        self.linearize()
        self.judge = trust_region.StepJudge(self.cost, options.max_uphill_steps)
        self.best, self.best_cost = states, self.cost
        self.rejected = 0
        self.singular: list[int] = []

    @property
    def cost(self) -> float:
        return sum(self.costs.values())

    def linearize(self) -> None:
        self.cost_has_changed = self.problem.relinearize(self.states)
        self.linear = self.problem.linearize(self.states, 1.0 / self.region.radius)
        self.costs = self.linear.costs

    def try_step(self) -> Step[S]:
        return self.problem.try_step(self.states, self.linear, 1.0 / self.region.radius)

    def is_small(self, norm: float) -> bool:
        tolerance = self.options.parameter_tolerance
        return tolerance > 0.0 and norm <= tolerance * (self.problem.norm(self.states) + tolerance)

    def has_converged(self, new_cost: float) -> bool:
        return abs(self.cost - new_cost) <= self.options.function_tolerance * self.cost

    def would_stop(self, step: Step[S]) -> bool:
        """Return whether a step ends the run: one of an iterative solver must then be exact."""
        return self.is_small(step.norm) or self.has_converged(step.cost)

    def is_stationary(self) -> bool:
        tolerance = self.options.gradient_tolerance
        return tolerance > 0.0 and self.problem.is_stationary(self.linear, tolerance)

    def accept(self, step: Step[S], gain: float) -> None:
        new_cost = step.cost
        self.decreases.add(self.cost - new_cost)
        self.recent.append(self.cost - new_cost)
        self.states, self.costs = step.states, step.costs
        self.region.accept(gain)
        if self.judge.accept(new_cost, step.promised):
            self.best, self.best_cost = step.states, new_cost

    def problem_changed(self) -> None:
        """Forget earlier costs: those before and after the change cannot be compared."""
        self.judge.restart(self.cost)
        self.decreases = trust_region.Decreases()
        self.best, self.best_cost = self.states, self.cost

    def cost_corrected(self, cost_before: float) -> None:
        """Shift all costs: terms that were linearised at new states give another one there."""
        difference = self.cost - cost_before
        self.judge.shift(difference)
        self.best_cost += difference

    def reject(self) -> None:
        self.region.reject()
        self.rejected += 1

    def return_to_best(self) -> None:
        """Undo uphill steps that led nowhere."""
        if self.best is not self.states and self.best_cost < self.cost:
            self.states = self.best
            self.linearize()


def optimize_states(
    problem: LeastSquares[S, L],
    states: S,
    options: SolverOptions,
    progress: Progress,
    after_step: Callable[[int, S], bool] | None = None,
) -> tuple[S, SolverSummary]:
    """Minimise the problem's cost from the given states.

    Args:
        problem: Terms and restrictions.
        states: Where to begin.
        options: When to stop.
        progress: Shown a line and a step of the bar each iteration; cancels between iterations.
        after_step: May exchange weights of the problem (outlier rejection).

    Raises:
        EstimationError: The cost is not finite at the beginning.
    """
    iterations = optimizing_states(problem, states, options, progress, after_step)
    with threads.single_blas_thread():
        while True:
            try:
                next(iterations)
            except StopIteration as end:
                states, summary = end.value
                return states, summary


def optimizing_states(
    problem: LeastSquares[S, L],
    states: S,
    options: SolverOptions,
    progress: Progress,
    after_step: Callable[[int, S], bool] | None = None,
) -> Generator[None, None, tuple[S, SolverSummary]]:
    """Minimise as `optimize_states` does, and pause after every iteration that does not end it.

    The caller limits the threads of BLAS. Time during pauses counts as that of the optimisation.
    """
    began = time.perf_counter()
    run = _Run(problem, states, options)
    initial = dict(run.costs)
    if not np.isfinite(run.cost):
        raise EstimationError(f"the cost is not finite before the first iteration: {initial}")
    termination, iterations = "iteration limit", 0
    for iteration in range(1, options.num_iterations + 1):
        progress.check()
        limit = options.num_iterations
        progress.step(iteration - 1, limit, f"iteration {iteration} of at most {limit}")
        if time.perf_counter() - began > options.max_time_seconds:
            termination = "time limit"
            break
        if run.is_stationary():
            termination = "gradient is zero"
            break
        iterations = iteration
        if reason := _iterate(run, iteration, progress, after_step):
            termination = reason
            break
        yield
    run.return_to_best()
    summary = SolverSummary(
        initial, dict(run.costs), iterations, run.rejected, termination,
        time.perf_counter() - began, tuple(dict.fromkeys(run.singular)),
        sum(run.recent), run.region.radius,
    )  # fmt: skip
    return run.states, summary


def _iterate(
    run: _Run[S, L], iteration: int, progress: Progress, after_step: Callable[[int, S], bool] | None
) -> str:
    """Try one step. Return why to stop; empty = go on."""
    options, cost, radius = run.options, run.cost, run.region.radius
    try:
        step = run.try_step()
        if step.refine is not None and run.would_stop(step):
            step = step.refine()
    except protocol.NotPositiveDefinite as error:
        run.singular.append(error.node)
        step = Step(run.states, {"": np.inf}, 0.0, np.inf)
    new_cost = step.cost
    gain = run.judge.gain(new_cost, step.promised)
    progress.line(
        f"{iteration:3d}  cost {cost:.5e} -> {new_cost:.5e}  gain {gain:5.2f}  "
        f"step {step.norm:.2e}  radius {radius:.1e}"
    )
    if run.is_small(step.norm):
        return "step is small"
    has_converged = run.has_converged(new_cost)
    if not np.isfinite(new_cost) or gain < _SUFFICIENT_GAIN:
        if has_converged:
            return "cost has converged"
        run.reject()
        if run.region.is_exhausted:
            return "no step lowers the cost"
        run.linearize()  # the elimination of the landmarks depends on the damping
        if run.cost_has_changed:
            run.cost_corrected(cost)
        return ""
    run.accept(step, gain)
    if after_step is not None and after_step(iteration, run.states):
        run.linearize()
        run.problem_changed()
        return ""
    if has_converged:
        return "cost has converged"
    if run.decreases.expected <= options.forecast_tolerance * new_cost:
        return "no more decrease is expected"
    if run.decreases.is_slow(new_cost, options.slow_ratio):
        return SLOW_CONVERGENCE
    if iteration < options.num_iterations:
        run.linearize()
        if run.cost_has_changed:
            run.cost_corrected(new_cost)
    return ""
