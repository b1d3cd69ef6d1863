"""Estimation of the calibration from all that a map contains, with its uncertainty and a report."""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.estimation import imu_interpolation
from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.algorithms.self_calibration.estimation.problem import (
    SegmentProblem,
    build_segment_problem,
    runs_of,
)
from maplab_py.algorithms.self_calibration.estimation.solution import (
    Solution,
    chi_square_per_freedom,
    solve_twice,
)
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.reports import ParameterEstimate, SelfCalibrationReport
from maplab_py.algorithms.self_calibration.segments.splitting import extract_submap
from maplab_py.algorithms.self_calibration.uncertainty import (
    LANDMARK_DAMPING,
    Uncertainty,
    name_directions,
    posterior_covariance,
    spectrum,
)
from maplab_py.algorithms.vi_optimization.solution import with_estimated_sensors
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.problem.marginals import cluster_robust_covariance
from maplab_py.estimation.states import States
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap, to_hex

_MAX_PRIOR_SHARE = 0.3**2
"""Data that leave more of the prior's variance in a direction are refused: if a device is one prior
deviation off, a share s of it remains, which is sqrt(s) of the reported deviation."""
_MAX_NAMES = 6
"""Undetermined directions that the message of a refusal names."""


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """Sensors with the estimated values, their uncertainty, and the solution."""

    sensors: SensorSet
    before: ParameterBlocks
    uncertainty: Uncertainty
    solution: Solution

    @property
    def parameters(self) -> Parameters:
        """The k parameters that were estimated."""
        return self.solution.problem.parameters

    @property
    def blocks(self) -> ParameterBlocks:
        """The estimated values."""
        return self.solution.states.blocks

    @property
    def change(self) -> F64:
        """Tangent vector (k,) from the calibration before."""
        return self.parameters.difference(self.blocks, self.before)

    def estimates(self) -> tuple[ParameterEstimate, ...]:
        """Return the rows of the report."""
        return parameter_estimates(self.parameters, self.before, self.change, self.uncertainty)


def calibrate(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    segments: int = 0,
    progress: Progress = SILENT,
) -> tuple[Calibration, SelfCalibrationReport]:
    """Calibrate on all that a map contains: segments, or whole missions (a full batch).

    Partitions whose metric scale is unobservable (the device only rotates there) are left out.

    Args:
        vi_map: Segments of a database, or a whole map.
        segments: Number of segments, for the report.

    Raises:
        EstimationError: The data do not determine the calibration; the message names the
            directions. Or there is nothing to estimate.
        MapError: Calibrations are missing.
    """
    began = time.perf_counter()
    corrected = (
        imu_interpolation.correct_interpolation_bias(vi_map) if options.imu_curvature else vi_map
    )
    initial = build_segment_problem(corrected, options, missions=missions, progress=progress)
    built = time.perf_counter()
    solution = solve_twice(initial, options, missions, progress)
    problem, states = solution.problem, solution.states
    lost = partitions_without_scale(problem, states, initial)
    rows = problem.selection.vertices
    rest = np.sort(rows[~np.isin(problem.partition[rows], lost)])
    if len(lost) and len(rest):
        submap = extract_submap(vi_map, rest)
        return _without_scale(
            submap, options, describe_partitions(problem, lost), segments, progress
        )
    uncertainty = Uncertainty(
        problem.parameters.prior_sigma,
        posterior_covariance(problem, states),
        cluster_robust_covariance(
            problem.problem, states, *problem.parameters.nodes(states), LANDMARK_DAMPING
        ),
        noise_factor=solution.track_test.noise_factor,
    )
    directions = spectrum(uncertainty.formal, problem.parameters).unobservable(_MAX_PRIOR_SHARE)
    unobservable = name_directions(directions, problem.parameters)
    if unobservable and not options.keep_unobservable_at_prior:
        raise EstimationError(_refusal(unobservable))
    if len(lost) and not unobservable:
        raise scale_refusal(problem, initial.states, states)
    calibration = Calibration(
        with_estimated_sensors(problem, states),
        initial.states.blocks,
        uncertainty,
        solution,
    )
    seconds = built - began, time.perf_counter() - built
    return calibration, _report(calibration, unobservable, segments, seconds)


def _without_scale(
    vi_map: VIMap,
    options: SelfCalibrationOptions,
    without_scale: tuple[str, ...],
    segments: int,
    progress: Progress,
) -> tuple[Calibration, SelfCalibrationReport]:
    """Calibrate on what remains without the partitions whose scale is unobservable."""
    try:
        result, report = calibrate(vi_map, options, segments=segments, progress=progress)
    except EstimationError as error:
        raise EstimationError(
            f"{error} (without {'; '.join(without_scale)}, where the device only turns and lengths "
            "are lost)"
        ) from error
    without_scale = (*without_scale, *report.without_scale)
    return result, dataclasses.replace(report, without_scale=without_scale)


def _refusal(names: tuple[str, ...]) -> str:
    shown = "; ".join(f"{name}: not excited" for name in names[:_MAX_NAMES])
    rest = names[_MAX_NAMES:]
    sensors = dict.fromkeys(name.split()[0] for name in rest)
    more = f"; and {len(rest)} more, of {', '.join(sensors)}" if rest else ""
    return (
        f"the data do not determine the calibration ({shown}{more}): record motion with turns and "
        "accelerations about all axes, estimate fewer --sc_states, or accept the prior there with "
        "--sc_keep_unobservable_at_prior"
    )


def _report(
    calibration: Calibration,
    unobservable: tuple[str, ...],
    segments: int,
    seconds: tuple[float, float],
) -> SelfCalibrationReport:
    solution, uncertainty = calibration.solution, calibration.uncertainty
    problem, rejection = solution.problem, solution.problem.rejection
    return SelfCalibrationReport(
        parameters=calibration.estimates(),
        unobservable=unobservable,
        without_scale=(),
        segments=segments,
        partitions=problem.num_partitions,
        gaps=problem.gaps,
        keyframes=len(problem.selection.vertices),
        landmarks=0 if rejection is None else int(np.count_nonzero(rejection.used_landmarks())),
        observations=0 if rejection is None else int(np.count_nonzero(rejection.is_used)),
        inconsistent_landmarks=solution.track_test.inconsistent,
        keypoint_noise_factor=uncertainty.noise_factor,
        track_deviation_factor=uncertainty.track_factor,
        cost_before=solution.first_cost,
        cost_after=sum(solution.summary.final_costs.values()),
        chi_square_per_freedom=chi_square_per_freedom(problem, solution.states),
        iterations=solution.iterations,
        termination=solution.summary.termination,
        seconds_pose=seconds[0],
        seconds_solve=seconds[1],
    )


def parameter_estimates(
    parameters: Parameters, before: ParameterBlocks, change: F64, uncertainty: Uncertainty
) -> tuple[ParameterEstimate, ...]:
    """Return the rows of a report.

    Args:
        parameters: What was estimated.
        before: Values before.
        change: (k,) from these.
        uncertainty: Of the k parameters.
    """
    columns = zip(
        parameters.each,
        parameters.values(before).tolist(),
        change.tolist(),
        uncertainty.sigma.tolist(),
        uncertainty.verdicts(),
        strict=True,
    )
    return tuple(
        ParameterEstimate(
            parameter=parameter.name,
            unit=parameter.unit,
            before=value,
            after=value + difference,
            sigma=sigma,
            change_in_sigmas=difference / max(sigma, 1e-300),
            verdict=verdict,
        )
        for parameter, value, difference, sigma, verdict in columns
    )


# Detect partitions whose metric scale is unobservable.
#
# Where a device only rotates, nothing determines lengths. Its landmarks and the lever arm of its camera
# can then shrink together during optimisation: accelerations vanish with them, no residual grows, and
# once everything is small all lengths seem certain. The linearised problem at the solution does not
# show this; the changed length of the path and distance of the landmarks does.
#
# Partitions have no length in common but the lever arm. Each is tested by itself, because one that only
# rotates would shrink beside others that do not, and bias the lever arm.


_MIN_RATIO = 0.5
"""A partition has lost its scale when the length of its path and the distances of its landmarks are
both less than this part of what they were, or both more than its inverse. Rotation on the spot
reduced both by 93 to 98 %. The path alone is no criterion: where a device moves slowly most of the
path may be drift, which calibration removes."""


def path_lengths_m(T_G_I: F64, run: I64, partition: I64) -> F64:
    """Return the length (P,) of the paths in every partition, summed over its runs [m].

    Args:
        T_G_I: Poses (V, 7).
        run: Run without gap (V,) of each, in the order of time.
        partition: Partition (V,) of each, all numbers from 0 to P - 1.
    """
    step = np.linalg.norm(np.diff(T_G_I[:, 4:], axis=0), axis=1)
    step[run[1:] != run[:-1]] = 0.0
    count = int(partition.max(initial=-1)) + 1
    return np.asarray(np.bincount(partition[1:], step, minlength=count), dtype=np.float64)


def distances_m(problem: SegmentProblem, states: States, partition: I64) -> F64:
    """Return the median distance (P,) between vertices and the landmarks they observe [m].

    It is nan for a partition without landmarks.
    """
    selection, vi_map = problem.selection, problem.vi_map
    vertex = selection.rows(vi_map.keypoint_vertex[selection.keypoints])
    landmark = np.searchsorted(
        selection.landmarks, vi_map.keypoints.landmark[selection.keypoints].astype(np.int64)
    )
    distance = np.linalg.norm(states.p_G[landmark] - states.T_G_I[vertex, 4:], axis=1)
    count = int(partition.max(initial=-1)) + 1
    by_partition = [distance[partition[vertex] == k] for k in range(count)]
    return np.array([np.median(part) if len(part) else np.nan for part in by_partition])


def partitions_without_scale(
    problem: SegmentProblem, after: States, initial: SegmentProblem
) -> I64:
    """Return the partitions whose path and landmark distances were at least halved or doubled.

    Args:
        problem: What was solved.
        after: The solution.
        initial: The problem at the first states, of the same vertices.
    """
    rows = problem.selection.vertices
    run, partition = runs_of(problem.vi_map)[rows], problem.partition[rows]
    before_m, after_m = (
        np.array([path_lengths_m(states.T_G_I, run, partition), distances_m(of, states, partition)])
        for of, states in ((initial, initial.states), (problem, after))
    )
    has_shrunk = np.all(after_m < _MIN_RATIO * before_m, axis=0)
    has_grown = np.all(_MIN_RATIO * after_m > before_m, axis=0)
    return np.flatnonzero(has_shrunk | has_grown)


def describe_partitions(problem: SegmentProblem, partitions: I64) -> tuple[str, ...]:
    """Return mission and time span, since the mission's first vertex here, of every run."""
    vi_map, rows = problem.vi_map, problem.selection.vertices
    run, time_ns = runs_of(vi_map), vi_map.vertices.timestamp_ns
    descriptions = []
    for number in np.unique(run[rows[np.isin(problem.partition[rows], partitions)]]).tolist():
        vertices = np.flatnonzero(run == number)
        mission = vi_map.vertices.mission[vertices[0]]
        start_ns = time_ns[vi_map.vertices.mission == mission].min()
        begin_s, end_s = (1e-9 * float(time_ns[k] - start_ns) for k in vertices[[0, -1]])
        name = to_hex(vi_map.missions.id[mission])[:8]
        descriptions.append(f"mission {name}, {begin_s:.1f} to {end_s:.1f} s")
    return tuple(descriptions)


def scale_refusal(problem: SegmentProblem, before: States, after: States) -> EstimationError:
    """Return the error that refuses a solution in which no partition kept its scale."""
    rows = problem.selection.vertices
    run, whole = runs_of(problem.vi_map)[rows], np.zeros(len(rows), dtype=np.int64)
    before_m, after_m = (path_lengths_m(vi_map.T_G_I, run, whole)[0] for vi_map in (before, after))
    return EstimationError(
        "the data do not determine the calibration (camera position and all other lengths: not "
        f"excited; solving took the path from {before_m:.2f} m to {after_m:.2f} m): record motion "
        "that also moves the device to and fro, with accelerations along all axes"
    )
