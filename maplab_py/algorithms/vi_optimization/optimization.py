"""Visual-inertial least squares over a map: build the problem, solve it, apply the result."""

import dataclasses
import time
from collections.abc import Callable

import numpy as np

from maplab_py.algorithms.scale_check import scale_doubts
from maplab_py.algorithms.vi_optimization import calibration_choice, report_building, solution
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem, build
from maplab_py.algorithms.vi_optimization.options import SolverFlags, VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.reports import CalibratedParameter, VIOptimizationReport
from maplab_py.array_types import I64, NDArray
from maplab_py.estimation.problem.solver import AfterStep, SolverOptions, optimize_states
from maplab_py.estimation.states import States
from maplab_py.progress import SILENT, Progress, SilentProgress
from maplab_py.vimap import VIMap

_DOUBTFUL_ERROR_PX = 3.0
_FEW_ITERATIONS = 3

Watch = Callable[[Callable[[], VIMap]], None]
"""Called between iterations with a function that returns the current map."""


def optimize(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    fixed_vertices: I64 | None = None,
    progress: Progress = SILENT,
    watch: Watch | None = None,
) -> tuple[VIMap, VIOptimizationReport]:
    """Optimise the free states of some missions (rows, None = all).

    Args:
        fixed_vertices: Vertices (rows) whose states are held fixed.
        watch: Called between iterations.

    Returns:
        The optimised map and a report of costs, reprojection errors and outliers.

    Raises:
        EstimationError: Nothing can be optimised, or the cost is not finite.
        MapError: Calibrations that the terms need are missing.
    """
    result, report = _optimize(vi_map, options, missions, progress, watch, fixed_vertices)
    if fixed_vertices is not None or not calibration_choice.may_free(options, report):
        return result, report
    free = calibration_choice.with_contradicted_freed(
        result, options, missions=missions, progress=progress
    )
    while free != options:
        options = free
        result, more = _optimize(result, options, missions, progress, watch)
        report = _joined(report, more, options)
        if calibration_choice.may_free_more(more):
            free = calibration_choice.with_contradicted_freed(
                result, options, missions=missions, progress=progress
            )
    return result, report


def contradicted_calibration(vi_map: VIMap, progress: Progress = SILENT) -> bool:
    """Return whether the residuals of a map contradict its calibration, before it has been optimised.

    After a few iterations the gains of a free calibration are about those at the optimum.
    """
    options = VIOptimizationOptions(calibration="auto", num_iterations=_FEW_ITERATIONS)
    quiet = _Quiet(progress)
    result, report = _optimize(vi_map, options, None, quiet, None)
    if not calibration_choice.can_factorise(report):
        return False
    return calibration_choice.with_contradicted_freed(result, options, progress=quiet) != options


def _joined(
    first: VIOptimizationReport, second: VIOptimizationReport, options: VIOptimizationOptions
) -> VIOptimizationReport:
    """Return the report of an optimisation and of what went on with a free calibration."""
    second = dataclasses.replace(
        second, calibration=_changes(first.calibration, second.calibration)
    )
    note = calibration_choice.freed_note(options, second)
    before = {row.mission: row for row in first.missions}
    missions = [
        dataclasses.replace(
            row,
            mean_before_px=before[row.mission].mean_before_px,
            median_before_px=before[row.mission].median_before_px,
        )
        for row in second.missions
        if row.mission in before
    ]
    return dataclasses.replace(
        second,
        note="; ".join(part for part in (note, second.note) if part),
        missions=missions,
        **{
            name: getattr(first, name)
            for name in (
                "cost_before", "observations", "mean_reprojection_before_px",
                "median_reprojection_before_px",
            )
        },
        **{
            name: getattr(first, name) + getattr(second, name)
            for name in ("iterations", "rejected_steps", "seconds_build", "seconds_solve", "seconds_total")
        },
    )  # fmt: skip


def _changes(
    first: list[CalibratedParameter], second: list[CalibratedParameter]
) -> list[CalibratedParameter]:
    """Return the rows of the second with what has changed since before the first."""
    before = {row.parameter: row for row in first}
    rows = []
    for row in second:
        known = before.get(row.parameter, row)
        if known is row:
            rows.append(row)
        elif row.before == known.after:
            rows.append(dataclasses.replace(row, before=known.before))
        else:  # poses are given as changes
            rows.append(dataclasses.replace(row, after=row.after + known.after))
    return rows


def _optimize(
    vi_map: VIMap,
    options: VIOptimizationOptions,
    missions: NDArray[np.integer] | None,
    progress: Progress,
    watch: Watch | None,
    fixed_vertices: I64 | None = None,
) -> tuple[VIMap, VIOptimizationReport]:
    """Optimise what the options leave free."""
    began = time.perf_counter()
    map_problem = build(
        vi_map, options, missions=missions, fixed_vertices=fixed_vertices, progress=progress
    )
    built = time.perf_counter()
    quiet = options.hide_iterations_console_output
    final, summary = optimize_states(
        map_problem.problem,
        map_problem.states,
        solver_options(options),
        _Quiet(progress) if quiet else progress,
        _after_step(map_problem, options, watch),
    )
    result = solution.apply_states(map_problem, final, options)
    report = report_building.make_report(map_problem, final, summary)
    doubts = [report.note] if report.note else []
    if report.median_reprojection_after_px > _DOUBTFUL_ERROR_PX:
        doubts.append(
            f"the median reprojection error is {report.median_reprojection_after_px:.1f} px: the map is not "
            "right yet; check the calibration"
        )
    report = dataclasses.replace(report, note="; ".join([*doubts, *scale_doubts(result)]))
    solved = time.perf_counter()
    return result, dataclasses.replace(
        report,
        seconds_build=built - began,
        seconds_solve=summary.seconds,
        seconds_total=solved - began,
    )


def _after_step(
    map_problem: MapProblem, options: VIOptimizationOptions, watch: Watch | None
) -> AfterStep | None:
    """Return the callback after an accepted step: it updates a watcher and rejects outliers."""
    reject = map_problem.rejection.after_step if map_problem.rejection is not None else None
    every = options.visualize_every_n_iterations
    if watch is None or every < 1:
        return reject

    def after_step(iteration: int, states: States) -> bool:
        if iteration % every == 0:
            watch(lambda: solution.apply_states(map_problem, states, options))
        return reject is not None and reject(iteration, states)

    return after_step


class _Quiet(SilentProgress):
    """Progress without output that checks for cancellation."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def check(self) -> None:
        """Raise Cancelled when the user wants to stop."""
        self._progress.check()


def solver_options(options: SolverFlags) -> SolverOptions:
    """Return the solver options of the flags."""
    return SolverOptions(
        num_iterations=options.num_iterations,
        max_time_seconds=options.max_time_seconds,
        initial_radius=options.initial_trust_region_radius,
        max_radius=options.max_trust_region_radius,
        min_radius=options.min_trust_region_radius,
        function_tolerance=options.function_tolerance,
        gradient_tolerance=options.gradient_tolerance,
        parameter_tolerance=options.parameter_tolerance,
        max_uphill_steps=(
            options.max_consecutive_nonmonotonic_steps if options.use_nonmonotonic_steps else 0
        ),
    )
