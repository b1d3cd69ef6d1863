"""Solution of the problem of segments: robust iterations, outlier rejection, least squares."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.triangulation import triangulate_keypoints
from maplab_py.algorithms.self_calibration.estimation.problem import (
    SegmentProblem,
    build_segment_problem,
    parallax_rad,
    vi_options,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.algorithms.vi_optimization.solution import apply_states
from maplab_py.array_types import Mask, mask_of
from maplab_py.estimation.problem.solver import (
    AfterStep,
    SolverOptions,
    SolverSummary,
    optimize_states,
)
from maplab_py.estimation.problem.trust_region import Schedule
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.inertial import BiasWalkTerm, InertialTerm
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import edits

_INITIAL_ITERATIONS = 8
"""Iterations before all landmarks are triangulated and outliers judged a second time."""
_INITIAL_TOLERANCE = 1e-3
_ROBUST_TOLERANCE = 1e-4
"""Tracks are tested when an iteration lowers the robust cost by less than this part of it."""
_MEASUREMENTS = (InertialTerm.name, BiasWalkTerm.name)
"""Terms, beside the visual ones, that are measurements and no priors."""


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """The optimum of a problem and how it was reached."""

    problem: SegmentProblem
    states: States
    track_test: TrackTest
    iterations: int
    first_cost: float
    summary: SolverSummary  # of the last iterations


def solve_twice(
    initial: SegmentProblem,
    options: SelfCalibrationOptions,
    missions: NDArray[np.integer] | None,
    progress: Progress,
) -> Solution:
    """Iterate a few times, triangulate all landmarks again, and solve.

    Observations that were outliers under the first calibration may fit the better one, and landmarks
    that diverged while the poses were wrong return.
    """
    few = dataclasses.replace(
        options, num_iterations=_INITIAL_ITERATIONS, function_tolerance=_INITIAL_TOLERANCE
    )
    states, first = solve(initial, few, progress)
    vi_map = apply_states(initial, states, vi_options(options))
    rows = np.arange(len(vi_map.landmarks))
    p_G, _, good = triangulate_keypoints(vi_map, vi_map.observations, vi_map.observation_start)
    problem = build_segment_problem(
        edits.with_p_G(vi_map, rows[good], p_G[good]),
        options,
        missions=missions,
        prior_mean=initial.states.blocks,
        progress=progress,
    )
    solution = solve_rejecting_outliers(problem, options, progress)
    return dataclasses.replace(
        solution,
        iterations=first.iterations + solution.iterations,
        first_cost=sum(first.initial_costs.values()),
    )


def solve_rejecting_outliers(
    problem: SegmentProblem, options: SelfCalibrationOptions, progress: Progress = SILENT
) -> Solution:
    """Minimise the robust cost, reject inconsistent tracks, and minimise the sum of squares."""
    if options.loss == "none" or options.inconsistent_probability <= 0.0:
        states, summary = solve(problem, options, progress)
        first_cost = sum(summary.initial_costs.values())
        return Solution(problem, states, TrackTest(), summary.iterations, first_cost, summary)
    tolerance = max(options.function_tolerance, _ROBUST_TOLERANCE)
    loose = dataclasses.replace(options, function_tolerance=tolerance)
    states, robust = solve(problem, loose, progress)
    angle_rad = parallax_rad(apply_states(problem, states, vi_options(options)))
    limit_rad = np.deg2rad(options.min_parallax_deg)
    track_test = reject_tracks_chi2(
        problem,
        states,
        options.inconsistent_probability,
        np.asarray(angle_rad[problem.selection.landmarks] >= limit_rad),
    )

    def refresh(_: int, now: States) -> bool:
        return problem.problem.visual is not None and problem.problem.visual.refresh(now)

    states, summary = _minimise(problem, states, options, progress, refresh)
    iterations = robust.iterations + summary.iterations
    first_cost = sum(robust.initial_costs.values())
    return Solution(problem, states, track_test, iterations, first_cost, summary)


def solve(
    problem: SegmentProblem, options: SelfCalibrationOptions, progress: Progress = SILENT
) -> tuple[States, SolverSummary]:
    """Minimise the cost from the problem's states, with rejection of outliers between steps."""
    after_step = problem.rejection.after_step if problem.rejection is not None else None
    return _minimise(problem, problem.states, options, progress, after_step)


def _minimise(
    problem: SegmentProblem,
    states: States,
    options: SelfCalibrationOptions,
    progress: Progress,
    after_step: AfterStep | None,
) -> tuple[States, SolverSummary]:
    solver = SolverOptions(
        num_iterations=options.num_iterations,
        function_tolerance=options.function_tolerance,
        schedule=Schedule.CERES,
    )
    return optimize_states(problem.problem, states, solver, progress, after_step)


def chi_square_per_freedom(problem: SegmentProblem, states: States) -> float:
    """Return the squared whitened residuals of all measurements per degree of freedom."""
    inner = problem.problem
    total, count, free = 0.0, 0, inner.degrees_of_freedom()
    if inner.visual is not None and problem.rejection is not None:
        data = inner.visual.observations
        error_px = np.nan_to_num(inner.visual.errors(states)[0])
        total += float(np.sum(np.square(error_px * data.inverse_sigma)))
        count += 2 * int(np.count_nonzero(data.inverse_sigma))
        free += 3 * int(np.count_nonzero(problem.rejection.used_landmarks()))
    for term in inner.factors:
        if term.name in _MEASUREMENTS:
            residual = term.evaluate(states)[0]
            total += float(np.sum(residual**2))
            count += residual.size
    return total / (count - free) if count > free else float("nan")


# Rejection of tracks that do not observe one point; all others then have their full weight.
#
# A robust loss limits the influence of outliers, but its weights on good measurements are neither those
# of the best estimate nor those that make its covariance right. Tracks that switched to another point
# have a large sum of squared residuals. Without them, plain least squares yields both.


_MIN_SHARE_LEFT = 2.0 / 3.0
"""Landmarks that keep a smaller share of their observations are rejected: the rest may be consistent
by accident."""
_NO_LOSS_SCALE = 1e3
"""Scale of a robust loss, in standard deviations, at which it has no effect."""


@dataclasses.dataclass(frozen=True)
class TrackTest:
    """Result of the chi-square test of tracks."""

    inconsistent: int = 0  # landmarks rejected
    noise_factor: float = 1.0  # measured keypoint noise over the map's


def reject_tracks_chi2(
    problem: MapProblem, states: States, probability: float, has_parallax: Mask | None = None
) -> TrackTest:
    """Reject landmarks with too large residuals; give the others full weight at the measured noise.

    Under the hypothesis that a landmark's n observations are of one point, the sum of their squared
    residuals is chi-square distributed with 2 n - 3 degrees of freedom, in units of the noise. The
    noise is not taken from the map. For the test it is estimated from the median over landmarks, for
    the weights from the sum over accepted landmarks, which the test biases by a known factor.

    Args:
        problem: The problem; its weights and its losses are replaced.
        states: Converged under a robust loss.
        probability: Of rejecting a good landmark.
        has_parallax: Landmarks (L,) with enough parallax, None = all; the others are rejected, too.
    """
    from scipy.stats import chi2

    visual, rejection = problem.problem.visual, problem.rejection
    if visual is None or rejection is None:
        return TrackTest()
    data = visual.observations
    owner, count = data.landmark, len(data.start) - 1
    squares = np.nan_to_num(visual.errors(states)[0] * data.inverse_sigma) ** 2
    total = np.bincount(owner, squares, minlength=count)
    if has_parallax is not None:
        inverse_sigma = np.where(has_parallax[owner], data.inverse_sigma, 0.0)
        data = dataclasses.replace(data, inverse_sigma=inverse_sigma)
    left = np.bincount(owner, data.inverse_sigma > 0.0, minlength=count)
    freedom = 2.0 * left - 3.0
    alive = np.flatnonzero(freedom > 0.0)
    whole = alive[left[alive] >= _MIN_SHARE_LEFT * np.diff(data.start)[alive]]
    if not len(whole):
        rejection.replace_weights(data)
        return TrackTest()
    variance = float(np.median(total[whole] / chi2.median(freedom[whole])))
    limit = chi2.isf(probability, freedom)
    kept = whole[total[whole] <= variance * limit[whole]]
    # mean of a chi-square below a limit: n F_{n+2}(limit) / F_n(limit)
    expected = freedom[kept] * chi2.cdf(limit[kept], freedom[kept] + 2.0) / (1.0 - probability)
    factor = float(np.sqrt(np.sum(total[kept]) / np.sum(expected)))
    is_kept = mask_of(count, kept)
    used = (data.inverse_sigma > 0.0) & is_kept[owner]
    rejection.replace_weights(
        dataclasses.replace(
            data,
            inverse_sigma=np.where(used, data.inverse_sigma / factor, 0.0),
            loss_scale=np.full(len(data), _NO_LOSS_SCALE),
        )
    )
    return TrackTest(len(alive) - len(kept), factor)
