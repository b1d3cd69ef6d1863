"""Estimate the calibration from segments, or from everything, and judge the result."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.triangulation import triangulate_keypoints
from maplab_py.algorithms.self_calibration.consistency import Consistency, keep_consistent
from maplab_py.algorithms.self_calibration.curvature import with_curvature
from maplab_py.algorithms.self_calibration.information import (
    Spectrum,
    name_direction,
    posterior_covariance,
    spectrum,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.parameters import Parameters
from maplab_py.algorithms.self_calibration.problem import SegmentProblem, pose, vi_options
from maplab_py.algorithms.self_calibration.reports import ParameterEstimate, SelfCalibrationReport
from maplab_py.algorithms.self_calibration.scale import (
    names_of,
    partitions_without_scale,
    refuse_lost_scale,
    without_partitions,
)
from maplab_py.algorithms.self_calibration.segments import parallax_rad, restricted
from maplab_py.algorithms.self_calibration.track_deviations import covariance_by_tracks
from maplab_py.algorithms.vi_optimization.writing_back import with_estimated_sensors, written_back
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.inertial_terms import InertialTerm
from maplab_py.estimation.solver import AfterStep, SolverOptions, SolverSummary, optimize_states
from maplab_py.estimation.states import States
from maplab_py.estimation.trust_region import Schedule
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import with_p_G

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROUGH = 8
"""Iterations before landmarks are triangulated anew and outliers judged again."""
_NEARLY = 1e-4
"""Outliers are told from the rest when an iteration lowers the robust cost by less than this."""
_UNDETERMINED = 0.3**2
"""Directions that keep more of the prior's variance are refused: of a device that is one prior
deviation off, a share s of it stays, which is sqrt(s) of the announced deviation."""
_UNKNOWN = 0.5
"""Parameters that keep more of it stay where they were: the data say less than the prior."""


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """A result: sensors with the new values, covariance, and the states it came from."""

    sensors: SensorSet
    parameters: Parameters
    before: ParameterBlocks
    covariance: F64  # (k, k), formal
    sigma_by_tracks: F64  # (k,), where the errors of a track may hang together
    spectrum: Spectrum
    problem: SegmentProblem
    states: States

    @property
    def change(self) -> F64:
        """Tangent vector (k,) that leads from the calibration before."""
        return self.parameters.difference(self.states.blocks, self.before)


def calibrate(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    segments: int = 0,
    progress: Progress = SILENT,
) -> tuple[Calibration, SelfCalibrationReport]:
    """Calibrate on all that a map holds: segments, or whole missions (a full batch).

    Partitions whose path has lost its length (the device only turned there) are left out.

    Args:
        vi_map: Segments of a database, or a whole map.
        options: What to estimate.
        missions: Missions (rows, None = all).
        segments: Number of segments, for the report.
        progress: Shown one line an iteration.

    Raises:
        EstimationError: The data do not determine the calibration; the message names the
            directions. Or there is nothing to estimate.
        MapError: Calibrations are missing.
    """
    began = time.perf_counter()
    sampled = with_curvature(vi_map) if options.imu_curvature else vi_map
    rough = pose(sampled, options, missions=missions, progress=progress)
    before = rough.posed.states.blocks
    posed = time.perf_counter()
    roughly = dataclasses.replace(options, num_iterations=_ROUGH, function_tolerance=1e-3)
    states, first = solve(rough, roughly, progress)
    problem = pose(
        _begun_anew(rough, states, options),
        options,
        missions=missions,
        prior_at=before,
        progress=progress,
    )
    states, summary, consistency = settled(problem, options, progress)
    lost = partitions_without_scale(problem, states, rough)
    rest = without_partitions(problem, lost)
    if len(lost) and len(rest):
        return _without_lost(
            restricted(vi_map, rest), options, names_of(problem, lost), segments, progress
        )
    covariance = posterior_covariance(problem, states)
    by_tracks = np.sqrt(np.diag(covariance_by_tracks(problem, states)))
    found = spectrum(covariance, problem.parameters)
    directions = found.unobservable(_UNDETERMINED)
    names = tuple(name_direction(one, problem.parameters) for one in directions.T)
    if names and not options.keep_unobservable_at_prior:
        raise EstimationError(_refusal(names))
    if len(lost) and not names:
        refuse_lost_scale(problem, rough.posed.states, states)
    calibration = Calibration(
        with_estimated_sensors(problem.posed, states),
        problem.parameters,
        before,
        covariance,
        by_tracks,
        found,
        problem,
        states,
    )
    report = _report(calibration, first, summary, names, segments, consistency)
    return calibration, dataclasses.replace(
        report, seconds_pose=posed - began, seconds_solve=time.perf_counter() - posed
    )


def _without_lost(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    lost: tuple[str, ...],
    segments: int,
    progress: Progress,
) -> tuple[Calibration, SelfCalibrationReport]:
    """Calibrate on what is left when parts without a scale are gone, from the beginning."""
    try:
        result, report = calibrate(vi_map, options, segments=segments, progress=progress)
    except EstimationError as error:
        raise EstimationError(
            f"{error} (without {'; '.join(lost)}, where the device only turns and lengths are lost)"
        ) from error
    return result, dataclasses.replace(report, without_scale=(*lost, *report.without_scale))


def settled(
    problem: SegmentProblem, options: SelfCalibrationOptions, progress: Progress
) -> tuple[States, SolverSummary, Consistency]:
    """Minimise robustly, leave out what does not fit, and minimise plainly."""
    if options.loss == "none" or options.inconsistent_probability <= 0.0:
        states, summary = solve(problem, options, progress)
        return states, summary, Consistency(0, 0, 1.0)
    nearly = dataclasses.replace(
        options, function_tolerance=max(options.function_tolerance, _NEARLY)
    )
    states, robust = solve(problem, nearly, progress)
    posed = problem.posed
    is_wide = _is_wide(problem, states, options)
    consistency = keep_consistent(posed, states, options.inconsistent_probability, is_wide)

    def refresh(_: int, now: States) -> bool:
        return posed.problem.visual is not None and posed.problem.visual.refresh(now)

    states, plain = _minimised(problem, states, options, progress, refresh)
    summary = dataclasses.replace(plain, iterations=robust.iterations + plain.iterations)
    return states, summary, consistency


def _is_wide(problem: SegmentProblem, states: States, options: SelfCalibrationOptions) -> Mask:
    """Return which landmarks (L,) of the problem have parallax, now that poses have settled."""
    found_rad = parallax_rad(written_back(problem.posed, states, vi_options(options)))
    limit_rad = np.deg2rad(options.min_parallax_deg)
    return np.asarray(found_rad[problem.posed.selection.landmarks] >= limit_rad)


def _begun_anew(problem: SegmentProblem, states: States, options: SelfCalibrationOptions) -> VIMap:
    """Return the map at the states, every landmark triangulated anew.

    What was an outlier under the first calibration may fit now, and landmarks that ran away while
    the poses were wrong come back.
    """
    vi_map = written_back(problem.posed, states, vi_options(options))
    rows = np.arange(len(vi_map.landmarks))
    p_G, _, good = triangulate_keypoints(vi_map, vi_map.observations, vi_map.observation_start)
    return with_p_G(vi_map, rows[good], p_G[good])


def _refusal(names: tuple[str, ...]) -> str:
    shown = "; ".join(f"{name}: not excited" for name in names[:6])
    sensors = dict.fromkeys(one.split()[0] for one in names[6:])
    more = f"; and {len(names) - 6} more, of {', '.join(sensors)}" if sensors else ""
    return (
        f"the data do not determine the calibration ({shown}{more}): record motion with turns and "
        "accelerations about all axes, estimate fewer --sc_states, or accept the prior there with "
        "--sc_keep_unobservable_at_prior"
    )


def solve(
    problem: SegmentProblem, options: SelfCalibrationOptions, progress: Progress
) -> tuple[States, SolverSummary]:
    """Minimise; outliers are rejected on the way."""
    posed = problem.posed
    after_step = posed.rejection.after_step if posed.rejection is not None else None
    return _minimised(problem, posed.states, options, progress, after_step)


def _minimised(
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
    return optimize_states(problem.posed.problem, states, solver, progress, after_step)


def _report(
    calibration: Calibration,
    first: SolverSummary,
    summary: SolverSummary,
    unobservable: tuple[str, ...],
    segments: int,
    consistency: Consistency,
) -> SelfCalibrationReport:
    problem, states = calibration.problem, calibration.states
    posed = problem.posed
    rejection = posed.rejection
    return SelfCalibrationReport(
        parameters=_estimates(calibration),
        unobservable=unobservable,
        without_scale=(),
        segments=segments,
        partitions=problem.num_partitions,
        gaps=problem.gaps,
        keyframes=len(posed.selection.vertices),
        landmarks=0 if rejection is None else int(np.count_nonzero(rejection.used_landmarks())),
        observations=0 if rejection is None else int(np.count_nonzero(rejection.is_used)),
        inconsistent_landmarks=consistency.inconsistent,
        keypoint_noise_factor=consistency.noise_factor,
        track_deviation_factor=float(np.median(calibration.sigma_by_tracks / _formal(calibration))),
        cost_before=sum(first.initial_costs.values()),
        cost_after=sum(summary.final_costs.values()),
        chi_square_per_freedom=chi_square_per_freedom(problem, states),
        iterations=first.iterations + summary.iterations,
        termination=summary.termination,
        seconds_pose=0.0,
        seconds_solve=0.0,
    )


def _formal(calibration: Calibration) -> F64:
    return np.sqrt(np.maximum(np.diag(calibration.covariance), 1e-300))


def _estimates(calibration: Calibration) -> tuple[ParameterEstimate, ...]:
    parameters = calibration.parameters
    formal = _formal(calibration)
    sigma = np.maximum(formal, calibration.sigma_by_tracks)
    before = starting_values(parameters, calibration.before)
    rows = []
    change = calibration.change
    for k, one in enumerate(parameters.each):
        share = (formal[k] / one.prior_sigma) ** 2
        verdict = "well determined" if share < 0.01 else "weakly determined"
        if share > _UNKNOWN:
            verdict = "not excited, left at its prior"
        rows.append(
            ParameterEstimate(
                one.name,
                one.unit,
                float(before[k]),
                float(before[k] + change[k]),
                float(sigma[k]),
                float(change[k] / max(sigma[k], 1e-300)),
                verdict,
            )
        )
    return tuple(rows)


def starting_values(parameters: Parameters, blocks: ParameterBlocks) -> F64:
    """Return the values (k,) before; those of poses and rotations count from zero."""
    values = np.zeros(len(parameters))
    for k, one in enumerate(parameters.each):
        block = blocks[one.block]
        if block.manifold.value == "vector":
            values[k] = block.values[one.row, one.column]
    return values


def chi_square_per_freedom(problem: SegmentProblem, states: States) -> float:
    """Return the squared whitened residuals of all measurements per degree of freedom."""
    inner, posed = problem.posed.problem, problem.posed
    total, count, free = 0.0, 0, inner.degrees_of_freedom()
    if inner.visual is not None and posed.rejection is not None:
        data = inner.visual.observations
        error_px = np.nan_to_num(inner.visual.errors(states)[0])
        total += float(np.sum(np.square(error_px * data.inverse_sigma)))
        count += 2 * int(np.count_nonzero(data.inverse_sigma))
        free += 3 * int(np.count_nonzero(posed.rejection.used_landmarks()))
    for term in inner.factors:
        if isinstance(term, InertialTerm) or term.name == "bias walk":
            residual = term.evaluate(states)[0]
            total += float(np.sum(residual**2))
            count += residual.size
    return total / (count - free) if count > free else float("nan")
