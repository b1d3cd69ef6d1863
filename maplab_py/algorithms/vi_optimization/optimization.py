"""Visual-inertial least squares over a map: pose the problem, solve it, write the result back."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.building import PosedProblem, build
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.report import VIOptimizationReport
from maplab_py.algorithms.vi_optimization.reporting import make_report
from maplab_py.algorithms.vi_optimization.writing_back import written_back
from maplab_py.estimation.solver import AfterStep, SolverOptions, optimize_states
from maplab_py.estimation.states import States
from maplab_py.estimation.trust_region import Schedule
from maplab_py.progress import SILENT, Progress, SilentProgress
from maplab_py.vimap import VIMap

Watch = Callable[[Callable[[], VIMap]], None]
"""Is shown, between iterations, how to make the map as it is now."""


def optimize(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
    watch: Watch | None = None,
) -> tuple[VIMap, VIOptimizationReport]:
    """Optimise the states that the options leave free of some missions (rows, None = all).

    Returns:
        The optimised map and a report of costs, reprojection errors and outliers.

    Raises:
        EstimationError: Nothing can be optimised, or the cost is not finite.
        MapError: Calibrations that the terms need are missing.
    """
    began = time.perf_counter()
    posed = build(vi_map, options, missions=missions, progress=progress)
    built = time.perf_counter()
    quiet = options.hide_iterations_console_output
    final, summary = optimize_states(
        posed.problem,
        posed.states,
        solver_options(options),
        _Quiet(progress) if quiet else progress,
        _after_step(posed, options, watch),
    )
    result = written_back(posed, final, options)
    report = make_report(posed, final, summary)
    solved = time.perf_counter()
    return result, dataclasses.replace(
        report,
        seconds_build=built - began,
        seconds_solve=summary.seconds,
        seconds_total=solved - began,
    )


def _after_step(
    posed: PosedProblem, options: VIOptimizationOptions, watch: Watch | None
) -> AfterStep | None:
    """Return what is done after an accepted step: showing it to a watcher, rejecting outliers."""
    reject = posed.rejection.after_step if posed.rejection is not None else None
    every = options.visualize_every_n_iterations
    if watch is None or every < 1:
        return reject

    def after_step(iteration: int, states: States) -> bool:
        if iteration % every == 0:
            watch(lambda: written_back(posed, states, options))
        return reject is not None and reject(iteration, states)

    return after_step


class _Quiet(SilentProgress):
    """Passes on cancellation only."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def check(self) -> None:
        """Raise Cancelled when the user wants to stop."""
        self._progress.check()


def solver_options(options: VIOptimizationOptions) -> SolverOptions:
    """Return how the solver is to run."""
    return SolverOptions(
        num_iterations=options.num_iterations,
        max_time_seconds=options.max_time_seconds,
        initial_radius=options.initial_trust_region_radius,
        max_radius=options.max_trust_region_radius,
        min_radius=options.min_trust_region_radius,
        function_tolerance=options.function_tolerance,
        gradient_tolerance=options.gradient_tolerance,
        parameter_tolerance=options.parameter_tolerance,
        schedule=Schedule(options.trust_region_schedule),
        max_uphill_steps=(
            options.max_consecutive_nonmonotonic_steps if options.use_nonmonotonic_steps else 0
        ),
    )
