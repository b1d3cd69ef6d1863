"""Compare a map's vertices with a ground-truth trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.evaluation import pose_errors
from maplab_py.algorithms.evaluation.options import DELTA_UNITS, TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.reports import (
    ErrorStatistics,
    MissionEvaluation,
    TrajectoryEvaluationReport,
)
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.association import nearest_rows
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.interop.trajectories import Trajectory
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, ids

_MIN_MATCHED = 3
_GAP_STEPS = 3


def evaluate_trajectory(
    vi_map: VIMap,
    ground_truth: Trajectory,
    options: TrajectoryEvaluationOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    progress: Progress = SILENT,
) -> TrajectoryEvaluationReport:
    """Return the errors of the vertices' T_G_I after a joint alignment of the chosen missions.

    Relative errors are computed within missions. A constant rotation between the body frame of the
    ground truth and the IMU changes the relative errors but not the positions; see
    `align_body_frame`.

    Args:
        vi_map: Map whose vertices have time stamps of the ground truth's clock.
        ground_truth: Poses in the order of time.
        options: What to compare and how.
        missions: Mission rows; None = all.
        progress: Checked once for cancelling.

    Raises:
        EstimationError: Fewer than three vertices have ground truth, or they cannot be aligned.
    """
    progress.check()
    rows = _vertex_rows(vi_map, missions)
    T_R_B, matched = match(ground_truth, vi_map.vertices.timestamp_ns[rows], options)
    if np.count_nonzero(matched) < _MIN_MATCHED:
        message = _no_match_message(vi_map, rows, ground_truth, matched)
        raise EstimationError(
            f"{message} (max_time_difference_s {options.max_time_difference_s:g})"
        )
    rows, T_R_B = rows[matched], T_R_B[matched]
    T_G_I = vi_map.T_G_I[rows]
    T_R_I, scale = pose_errors.align(T_R_B, T_G_I, options.alignment)
    q_B_I = pose_errors.mean_rotation(so3.multiply(so3.inverse(T_R_B[:, :4]), T_R_I[:, :4]))
    if options.align_body_frame:
        T_R_B = se3.compose(T_R_B, se3.make(q_B_I, np.zeros(3)))
    ape_m, ape_deg = pose_errors.absolute_errors(T_R_B, T_R_I)
    sim3, sim3_scale = _similarity(T_R_B, T_G_I)
    rpe_m, rpe_deg = _relative(vi_map, rows, T_R_B, T_R_I, options)
    kind = "all pairs" if options.rpe_all_pairs else "consecutive"
    return TrajectoryEvaluationReport(
        ground_truth=ground_truth.source,
        alignment=options.alignment,
        vertices=len(matched),
        matched=len(rows),
        without_ground_truth=len(matched) - len(rows),
        ape_m=pose_errors.statistics(ape_m),
        ape_deg=pose_errors.statistics(ape_deg),
        ape_sim3_m=sim3,
        scale=scale if options.alignment == "sim3" else sim3_scale,
        body_rotation_deg=float(np.degrees(np.linalg.norm(so3.log(q_B_I)))),
        rpe_m=rpe_m,
        rpe_deg=rpe_deg,
        rpe_pieces=f"{options.rpe_delta:g} {options.rpe_delta_unit}, {kind}",
        missions=_by_mission(vi_map, rows, T_R_B, options),
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
    poses = ground_truth.T_R_B[first]
    nearest = nearest_rows(stamps, times_ns)
    tolerance_ns = round(options.max_time_difference_s * 1e9)
    is_near = np.abs(stamps[nearest] - times_ns) <= tolerance_ns
    if not options.interpolate:
        return poses[nearest], is_near
    usual_step_ns = int(np.median(np.diff(stamps))) if len(stamps) > 1 else 0
    gap_ns = max(2 * tolerance_ns, _GAP_STEPS * usual_step_ns, 1)
    T_R_B, inside = interpolate_poses(stamps, poses, times_ns, max_gap_ns=gap_ns)
    return T_R_B, is_near & inside


def _vertex_rows(vi_map: VIMap, missions: NDArray[np.integer] | None) -> I64:
    if missions is None:
        return np.arange(len(vi_map.vertices), dtype=np.int64)
    chosen = np.zeros(len(vi_map.missions), dtype=np.bool_)
    chosen[missions] = True
    return np.flatnonzero(chosen[vi_map.vertices.mission])


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


def _similarity(T_R_B: F64, T_G_I: F64) -> tuple[ErrorStatistics | None, float | None]:
    """Return position errors after a Sim(3) alignment and its scale; None if it is degenerate."""
    try:
        aligned, scale = pose_errors.align(T_R_B, T_G_I, "sim3")
    except EstimationError:
        return None, None
    return pose_errors.statistics(pose_errors.absolute_errors(T_R_B, aligned)[0]), scale


def _relative(
    vi_map: VIMap, rows: I64, T_R_B: F64, T_R_I: F64, options: TrajectoryEvaluationOptions
) -> tuple[ErrorStatistics | None, ErrorStatistics | None]:
    """Return statistics of the relative errors [m], [deg] of segments within missions."""
    mission = vi_map.vertices.mission[rows]
    times_s = (vi_map.vertices.timestamp_ns[rows] - vi_map.vertices.timestamp_ns[rows].min()) * 1e-9
    if options.rpe_delta_unit not in DELTA_UNITS:
        raise EstimationError(f"--rpe_delta_unit must be one of {', '.join(DELTA_UNITS)}")
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
) -> tuple[MissionEvaluation, ...]:
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
        results.append(MissionEvaluation(mission_id, len(members), rmse))
    return tuple(results)


def _groups(mission: NDArray[np.int32]) -> list[I64]:
    """Return the places (n,) of each mission; vertices are sorted by mission."""
    cuts = np.flatnonzero(np.diff(mission)) + 1
    return np.split(np.arange(len(mission), dtype=np.int64), cuts)
