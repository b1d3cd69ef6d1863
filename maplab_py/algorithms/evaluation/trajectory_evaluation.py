"""Compare a map's vertices with a ground-truth trajectory."""

import dataclasses

import numpy as np

from maplab_py.algorithms.evaluation import plausibility, pose_errors, reports
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import EstimationError
from maplab_py.geometry import interpolation, se3, so3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, ids, mission_mask

_MIN_MATCHED = 3
_LEAST_CLOCK_S = 0.005
"""Errors that the usual motion makes in less time are not searched for a wrong clock."""
_CLEARLY, _LITTLE, _LARGEST_SHARE = 0.5, 0.9, 0.2
"""Another clock leaves half of the error, or little less of it but half of that of turning, and at most this
share of the spread of the positions."""
_MIN_SHARE = 0.3
_GAP_STEPS = 3


def evaluate_trajectory(
    vi_map: VIMap,
    ground_truth: Trajectory,
    options: TrajectoryEvaluationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> reports.TrajectoryEvaluationReport:
    """Return the errors of the vertices' T_G_I after a joint alignment of the chosen missions.

    Relative errors are computed within missions. A constant rotation between the body frame of the
    ground truth and the IMU changes the relative errors but not the positions; see
    `align_body_frame`.

    Args:
        vi_map: Map whose vertices have time stamps of the ground truth's clock.
        ground_truth: Poses in the order of time.

    Raises:
        EstimationError: Fewer than three vertices have ground truth, or they cannot be aligned.
    """
    progress.check()
    rows = np.flatnonzero(mission_mask(vi_map, missions)[vi_map.vertices.mission])
    T_R_B, matched = match(ground_truth, vi_map.vertices.timestamp_ns[rows], options)
    if np.count_nonzero(matched) < _MIN_MATCHED:
        message = _no_match_message(vi_map, rows, ground_truth, matched)
        hint = clock_hint(vi_map, rows, ground_truth, options)
        raise EstimationError(
            f"{message} (max_time_difference_s {options.max_time_difference_s:g})"
            + (f"; {hint}" if hint else "")
        )
    every, rows, T_R_B = rows, rows[matched], T_R_B[matched]
    T_G_I = vi_map.T_G_I[rows]
    T_R_I, scale = pose_errors.align(T_R_B, T_G_I, options.alignment)
    hint, body_rotation_deg = clock_hint(vi_map, every, ground_truth, options), None
    if ground_truth.has_orientation:
        hint = hint or plausibility.orientation_hint(T_R_B[:, :4], T_R_I[:, :4])
        q_B_I = pose_errors.mean_rotation(so3.multiply(so3.inverse(T_R_B[:, :4]), T_R_I[:, :4]))
        body_rotation_deg = float(np.degrees(np.linalg.norm(so3.log(q_B_I))))
        if options.align_body_frame:
            T_R_B = se3.compose(T_R_B, se3.make(q_B_I, np.zeros(3)))
    ape_m, ape_deg = (
        pose_errors.statistics(error) for error in pose_errors.absolute_errors(T_R_B, T_R_I)
    )
    sim3, sim3_scale = _similarity(T_R_B, T_G_I)
    rpe_m, rpe_deg = None, None
    if ground_truth.has_orientation:
        rpe_m, rpe_deg = _relative(vi_map, rows, T_R_B, T_R_I, options)
    kind = "all pairs" if options.rpe_all_pairs else "consecutive"
    return reports.TrajectoryEvaluationReport(
        ground_truth=ground_truth.source,
        alignment=options.alignment,
        vertices=len(matched),
        matched=len(rows),
        without_ground_truth=len(matched) - len(rows),
        ape_m=ape_m,
        ape_deg=ape_deg if ground_truth.has_orientation else None,
        ape_sim3_m=sim3,
        scale=scale if options.alignment == "sim3" else sim3_scale,
        body_rotation_deg=body_rotation_deg,
        rpe_m=rpe_m,
        rpe_deg=rpe_deg,
        rpe_pieces=f"{options.rpe_delta:g} {options.rpe_delta_unit}, {kind}",
        missions=_by_mission(vi_map, rows, T_R_B, options),
        notes=(hint,) if hint else (),
    )


def clock_hint(
    vi_map: VIMap,
    rows: I64,
    ground_truth: Trajectory,
    options: TrajectoryEvaluationOptions,
) -> str:
    """Return a clause on the offset of the clocks that leaves a much smaller error; empty without one.

    Args:
        rows: Vertices; of several missions the longest is compared.
        ground_truth: Poses or positions in the order of time.
    """
    if len(ground_truth) < _MIN_MATCHED or len(rows) < _MIN_MATCHED:
        return ""
    stamps, T_G_I = vi_map.vertices.timestamp_ns, vi_map.T_G_I
    seconds = float(ground_truth.times_ns[-1] - ground_truth.times_ns[0]) * 1e-9
    spread_m = np.sqrt(np.sum(np.var(ground_truth.T_R_B[:, 4:], axis=0)))
    path_m = np.sum(np.linalg.norm(np.diff(ground_truth.T_R_B[:, 4:], axis=0), axis=1))
    mission = vi_map.vertices.mission[rows]
    longest = rows[max(_groups(mission), key=len)]
    given_s = options.time_offset_s

    def truth_at(offset_ns: int) -> tuple[F64, NDArray[np.bool_]]:
        shifted = dataclasses.replace(options, time_offset_s=given_s + offset_ns * 1e-9)
        return match(ground_truth, stamps[longest], shifted)

    def turning_error_at(offset_ns: int) -> float:
        """Compare how far both turn from vertex to vertex, which no frame and no order changes."""
        T_R_B, matched = truth_at(offset_ns)
        both = matched[:-1] & matched[1:]
        angles = [
            np.linalg.norm(so3.log(so3.multiply(so3.inverse(T[:-1, :4]), T[1:, :4])), axis=1)[both]
            for T in (T_R_B, T_G_I[longest])
        ]
        return float(np.sqrt(np.mean((angles[0] - angles[1]) ** 2))) if both.any() else np.inf

    def error_at(offset_ns: int) -> float:
        T_R_B, matched = truth_at(offset_ns)
        if np.count_nonzero(matched) < max(_MIN_MATCHED, _MIN_SHARE * len(longest)):
            return np.inf
        try:
            T_R_I, _ = pose_errors.align(T_R_B[matched], T_G_I[longest][matched], options.alignment)
        except EstimationError:
            return np.inf
        return float(np.sqrt(np.mean(np.sum((T_R_I - T_R_B[matched])[:, 4:] ** 2, axis=1))))

    error_m = error_at(0)
    if error_m * seconds < _LEAST_CLOCK_S * path_m:
        return ""
    result = plausibility.clock_offset_ns(
        ground_truth.times_ns + round(given_s * 1e9),
        ground_truth.T_R_B,
        stamps[longest],
        T_G_I[longest],
        error_at,
        has_orientation=ground_truth.has_orientation,
    )
    if result is None or result[1] > min(_LITTLE * error_m, _LARGEST_SHARE * spread_m):
        return ""
    if result[1] > _CLEARLY * error_m and not (
        ground_truth.has_orientation
        and turning_error_at(result[0]) < _CLEARLY * turning_error_at(0)
    ):
        return ""
    return (
        f"the clocks seem to differ: --time_offset_s={given_s + result[0] * 1e-9:.4f} would leave an APE of "
        f"{result[1]:.3g} m"
    )


def match(
    ground_truth: Trajectory, times_ns: I64, options: TrajectoryEvaluationOptions
) -> tuple[F64, NDArray[np.bool_]]:
    """Return the ground-truth poses (N, 7) at the times (N,) and a mask (N,) of those that exist.

    A pose exists if the ground truth has one within the tolerance. Interpolation does not bridge
    gaps longer than twice the tolerance and three median steps of the ground truth.
    """
    if len(ground_truth) == 0:
        return se3.identity(len(times_ns)), np.zeros(len(times_ns), dtype=np.bool_)
    # of several poses at one instant the first
    stamps, first = np.unique(ground_truth.times_ns, return_index=True)
    stamps = stamps + round(options.time_offset_s * 1e9)
    poses = ground_truth.T_R_B[first]
    nearest = interpolation.nearest_rows(stamps, times_ns)
    tolerance_ns = round(options.max_time_difference_s * 1e9)
    is_near = np.abs(stamps[nearest] - times_ns) <= tolerance_ns
    if not options.interpolate:
        return poses[nearest], is_near
    usual_step_ns = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
    gap_ns = max(2 * tolerance_ns, _GAP_STEPS * usual_step_ns, 1)
    T_R_B, inside = interpolation.interpolate_poses(stamps, poses, times_ns, max_gap_ns=gap_ns)
    return T_R_B, is_near & inside


def _no_match_message(
    vi_map: VIMap, rows: I64, ground_truth: Trajectory, matched: NDArray[np.bool_]
) -> str:
    match_count = int(np.count_nonzero(matched))
    message = (
        f"only {match_count} of {len(rows)} vertices have ground truth, {_MIN_MATCHED} are needed"
    )
    if len(rows) == 0 or len(ground_truth) == 0:
        return message
    times = vi_map.vertices.timestamp_ns[rows]
    return (
        f"{message}: vertices are at {times.min()} to {times.max()} ns, ground truth at "
        f"{ground_truth.times_ns[0]} to {ground_truth.times_ns[-1]} ns"
    )


def _similarity(T_R_B: F64, T_G_I: F64) -> tuple[reports.ErrorStatistics | None, float | None]:
    """Return position errors after a Sim(3) alignment and its scale; None if it is degenerate."""
    try:
        aligned, scale = pose_errors.align(T_R_B, T_G_I, "sim3")
    except EstimationError:
        return None, None
    return pose_errors.statistics(pose_errors.absolute_errors(T_R_B, aligned)[0]), scale


def _relative(
    vi_map: VIMap, rows: I64, T_R_B: F64, T_R_I: F64, options: TrajectoryEvaluationOptions
) -> tuple[reports.ErrorStatistics | None, reports.ErrorStatistics | None]:
    """Return statistics of the relative errors [m], [deg] of segments within missions."""
    mission = vi_map.vertices.mission[rows]
    times_s = (vi_map.vertices.timestamp_ns[rows] - vi_map.vertices.timestamp_ns[rows].min()) * 1e-9
    parts = []
    for members in _groups(mission):
        if options.rpe_delta_unit == "frames":
            if options.rpe_delta != round(options.rpe_delta):
                raise EstimationError("--rpe_delta must be a whole number of frames")
            pairs = pose_errors.pairs_by_frames(
                len(members), round(options.rpe_delta), all_pairs=options.rpe_all_pairs
            )
        else:
            metres = np.linalg.norm(np.diff(T_R_I[members, 4:], axis=0), axis=1)
            steps = metres if options.rpe_delta_unit == "m" else np.diff(times_s[members])
            pairs = pose_errors.pairs_by_length(
                steps, options.rpe_delta, all_pairs=options.rpe_all_pairs
            )
        parts.append(members[pairs])
    pairs = np.concatenate(parts)
    if len(pairs) == 0:
        return None, None
    metres, degrees = pose_errors.relative_errors(T_R_B, T_R_I, pairs)
    return pose_errors.statistics(metres), pose_errors.statistics(degrees)


def _by_mission(
    vi_map: VIMap, rows: I64, T_R_B: F64, options: TrajectoryEvaluationOptions
) -> tuple[reports.MissionEvaluation, ...]:
    """Evaluate each mission with a separate alignment."""
    mission = vi_map.vertices.mission[rows]
    results = []
    for members in _groups(mission):
        T = T_R_B[members]
        rmse: float | None = None
        try:
            aligned, _ = pose_errors.align(T, vi_map.T_G_I[rows[members]], options.alignment)
            rmse = pose_errors.statistics(pose_errors.absolute_errors(T, aligned)[0]).rmse
        except EstimationError:
            rmse = None
        mission_id = ids.to_hex(vi_map.missions.id[mission[members[0]]])
        results.append(reports.MissionEvaluation(mission_id, len(members), rmse))
    return tuple(results)


def _groups(mission: NDArray[np.int32]) -> list[I64]:
    """Return the places (n,) of each mission; vertices are sorted by mission."""
    cuts = np.flatnonzero(np.diff(mission)) + 1
    return np.split(np.arange(len(mission), dtype=np.int64), cuts)
