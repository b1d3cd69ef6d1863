"""Find loop closures between the clouds of a map and add them as edges."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions, CloudClosureReport
from maplab_py.algorithms.cloud_registration.registration import (
    PreparedCloud,
    Registration,
    correspondences,
    kiss_matcher,
    register_clouds,
)
from maplab_py.algorithms.cloud_registration.scans import (
    CloudPairs,
    CloudReader,
    Scans,
    map_scans,
    pairs_by_position,
    pairs_everywhere,
    pairs_from_closures,
)
from maplab_py.algorithms.loop_closure import closure_table, gates, record_updates, workflow
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, NDArray, Rows
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import IdIndex, LoopClosureEdges, VIMap
from maplab_py.vision.absolute_pose import PoseSolutions


def close_cloud_loops(
    vi_map: VIMap,
    map_folder: Path,
    options: CloudClosureOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, CloudClosureReport]:
    """Register clouds of sensors and add accepted closures as edges; all are recorded.

    An edge of an earlier search between the same clouds is replaced.

    Args:
        map_folder: Folder of the map, for its resources.

    Raises:
        UserError: There are no clouds, or a library is missing.
        MapError: A cloud is missing or damaged.
        Cancelled: The user wants to stop.
    """
    chosen = np.arange(len(vi_map.missions)) if missions is None else missions
    scans = map_scans(vi_map, chosen, options.every_nth)
    pairs = _pairs(vi_map, scans, options)
    matches = register_pairs(vi_map, map_folder, scans, pairs, options, progress)
    closures = judge_matches(vi_map, scans, matches, options)
    edges = closure_table.closure_edges(
        closures,
        LoopClosureOptions(
            edge_covariance_scaler=options.covariance_scaler,
            switch_variable_variance=options.switch_variable_variance,
        ),
    )
    old = vi_map.loop_closure_edges
    kept = old.take(IdIndex(edges.id).rows(old.id) < 0)
    result = vi_map.replace(loop_closure_edges=LoopClosureEdges.concatenate([kept, edges]))
    used = closures.accepted & (IdIndex(edges.id).rows(closures.id) >= 0)
    result = record_updates.with_closures(result, closures, "edge", used=used)
    return result, _report(vi_map, scans, pairs, matches, closures, len(edges))


def _pairs(vi_map: VIMap, scans: Scans, options: CloudClosureOptions) -> CloudPairs:
    if options.search_globally:
        return pairs_everywhere(scans, options)
    if options.from_closures:
        return pairs_from_closures(vi_map, scans, options)
    return pairs_by_position(vi_map, scans, options)


def _report(
    vi_map: VIMap,
    scans: Scans,
    pairs: CloudPairs,
    matches: CloudMatches,
    closures: closure_table.Closures,
    edges: int,
) -> CloudClosureReport:
    accepted = closures.accepted
    report = CloudClosureReport(
        clouds=len(scans),
        pairs=len(pairs),
        accepted=int(np.count_nonzero(accepted)),
        edges_added=edges,
        refused=closures.refused_by_reason(),
        missions_joined=workflow.missions_joined(vi_map, closures),
        notes=_notes(pairs, matches),
    )
    if not edges:
        return dataclasses.replace(report, reason=_reason(report, matches))
    correction = closures.correction_m[accepted]
    return dataclasses.replace(
        report,
        median_overlap=float(np.median(matches.overlap[accepted])),
        median_residual_m=float(np.median(matches.residual_m[accepted])),
        median_correction_m=float(np.median(correction)),
        largest_correction_m=float(correction.max()),
    )


def _notes(pairs: CloudPairs, matches: CloudMatches) -> tuple[str, ...]:
    lost = len(pairs) - len(matches)
    return (f"{lost} pairs have no common features for a global registration",) if lost else ()


def _reason(report: CloudClosureReport, matches: CloudMatches) -> str:
    if not report.pairs:
        return (
            f"no loop closures: no two of {report.clouds} clouds are near one another "
            "(--lidar_lc_max_distance_m) and apart in time (--lidar_lc_min_time_gap_s), or the base "
            "frames of their missions are unknown (--lidar_lc_global)"
        )
    refused = ", ".join(f"{why}: {n}" for why, n in report.refused.items())
    best = f"; largest overlap {matches.overlap.max():.2f}" if len(matches) else ""
    return (
        f"no loop closures: {report.pairs} pairs were registered{best}; refused: {refused or 'all'}"
    )


_ID_OF_CLOUDS = np.uint64(0x6C696461725F6C63)
"""Closures of clouds and of images between the same vertices have different ids."""


class CloudMatches(Rows):
    """Registered pairs (N) of clouds."""

    query: I64  # (N,) rows of the scans
    place: I64
    T_P_Q: F64  # (N, 7) sensor poses
    information: F64  # (N, 6, 6) of [dp, dtheta] on the right of T_P_Q
    overlap: F64  # (N,)
    conflict: F64  # (N,)
    residual_m: F64  # (N,)
    constraint: F64  # (N,)
    compared: I64  # (N,) points
    agreeing: I64  # (N,) points


def register_pairs(
    vi_map: VIMap,
    map_folder: Path,
    scans: Scans,
    pairs: CloudPairs,
    options: CloudClosureOptions,
    progress: Progress = SILENT,
) -> CloudMatches:
    """Register pairs of clouds; those that global registration does not match are left out.

    Raises:
        UserError: A library is missing.
        MapError: A cloud is missing, damaged or has too few points.
        Cancelled: The user wants to stop.
    """
    reader = CloudReader(vi_map, map_folder, options.voxel_size_m)
    rows, fits, overlaps = [], list[Registration](), list[Overlap]()
    for row in range(len(pairs)):
        progress.step(row, len(pairs), "registration of clouds")
        source = reader.cloud(int(scans.resource[pairs.query[row]]))
        target = reader.cloud(int(scans.resource[pairs.place[row]]))
        start = _start(target, source, pairs.T_P_Q[row], options)
        if start is None:
            continue
        fit = register_clouds(target, source, start, options.max_correspondence_m)
        rows.append(row)
        fits.append(fit)
        overlaps.append(compare_clouds(target, source, fit.T_T_S))
    return _matches(pairs, rows, fits, overlaps)


def _start(
    target: PreparedCloud, source: PreparedCloud, T_P_Q: F64, options: CloudClosureOptions
) -> F64 | None:
    if np.isfinite(T_P_Q).all():
        return T_P_Q
    return register_globally(target, source, options.voxel_size_m)


def _matches(
    pairs: CloudPairs, rows: list[int], fits: list[Registration], overlaps: list[Overlap]
) -> CloudMatches:
    return CloudMatches(
        pairs.query[rows],
        pairs.place[rows],
        np.array([fit.T_T_S for fit in fits]).reshape(-1, 7),
        np.array([fit.information for fit in fits]).reshape(-1, 6, 6),
        np.array([o.overlap for o in overlaps]),
        np.array([o.conflict for o in overlaps]),
        np.array([fit.residual_m for fit in fits]),
        np.array([fit.constraint for fit in fits]),
        np.array([o.compared for o in overlaps], dtype=np.int64),
        np.array([o.agreeing for o in overlaps], dtype=np.int64),
    )


def judge_matches(
    vi_map: VIMap, scans: Scans, matches: CloudMatches, options: CloudClosureOptions
) -> closure_table.Closures:
    """Return registered pairs as closures of the vertices nearest in time, with verdicts.

    The gates of the registration come first. What passes is judged like closures of images: removed by
    hand, gravity, plausible drift, places that look alike, agreement of neighbours.
    """
    solutions = _solutions(vi_map, scans, matches)
    query, place = scans.vertex[matches.query], scans.vertex[matches.place]
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    measured = dataclasses.replace(
        gates.measure(vi_map, query, place, solutions, is_known),
        verdict=_fit_verdicts(matches, options),
    )
    T_M_I, thresholds = solutions.T_M_I, _closure_options(options)
    judged, _ = gates.judge(vi_map, query, place, T_M_I, measured, thresholds)
    alone = judged.accepted & (
        judged.support < options.min_support
    )  # inliers do not replace it here
    judged.verdict[alone], judged.difference[alone] = (
        closure_table.VERDICTS.index(Verdict.NO_SUPPORT),
        0.0,
    )
    none = np.zeros(0, dtype=np.int64)
    return closure_table.Closures(
        **vars(judged),
        id=closure_table.closure_ids(vi_map, query, place) ^ _ID_OF_CLOUDS,
        query_vertex=query,
        place_vertex=place,
        T_M_I=T_M_I,
        T_A_B=se3.relative(T_M_I, vi_map.vertices.T_M_I[place]),
        covariance=solutions.covariance,
        start=np.zeros(len(matches) + 1, dtype=np.int64),
        keypoint=none,
        landmark=none,
        bits=none.astype(np.int32),
    )


def _fit_verdicts(matches: CloudMatches, options: CloudClosureOptions) -> NDArray[np.int8]:
    """Return the codes (N,) of the first gate of the registration that a pair fails."""
    accepted = closure_table.VERDICTS.index(Verdict.ACCEPTED)
    verdict = np.full(len(matches), accepted, dtype=np.int8)
    for failed, reason in (
        (matches.overlap < options.min_overlap, Verdict.SMALL_OVERLAP),
        (matches.residual_m > options.max_residual_m, Verdict.BAD_FIT),
        (matches.conflict > options.max_conflict, Verdict.BAD_FIT),
        (matches.constraint < options.min_constraint, Verdict.DEGENERATE),
    ):
        verdict[failed & (verdict == accepted)] = closure_table.VERDICTS.index(reason)
    return verdict


def _solutions(vi_map: VIMap, scans: Scans, matches: CloudMatches) -> PoseSolutions:
    """Return the poses of the query vertices (Q) in the mission frames of the places (M)."""
    place, query = matches.place, matches.query
    T_M_P = se3.compose(vi_map.vertices.T_M_I[scans.vertex[place]], scans.T_V_S[place])
    T_I_Q = scans.T_V_S[query]
    T_M_I = se3.compose(se3.compose(T_M_P, matches.T_P_Q), se3.inverse(T_I_Q))
    now = vi_map.vertices.T_M_I[scans.vertex[query]]
    up = np.array([0.0, 0.0, 1.0])
    cosine = np.einsum(
        "ni,ni->n",
        so3.rotate(so3.inverse(now[:, :4]), up),
        so3.rotate(so3.inverse(T_M_I[:, :4]), up),
    )
    return PoseSolutions(
        T_M_I=T_M_I,
        inlier_count=matches.agreeing,
        keypoint_count=matches.compared,
        is_inlier=np.zeros(0, dtype=np.bool_),
        covariance=_covariance(matches.information, T_I_Q, T_M_I),
        tilt_rad=np.arccos(np.clip(cosine, -1.0, 1.0)),
    )


def _covariance(information: F64, T_I_Q: F64, T_M_I: F64) -> F64:
    """Return the covariance (N, 6, 6) of T_M_I in the convention of `se3`; NaN where undetermined.

    With d on the right of T_P_Q, T_M_I changes on its right by Ad(T_I_Q) d.
    """
    result = np.full((len(information), 6, 6), np.nan)
    eigenvalues = np.linalg.eigvalsh(information)
    usable = np.flatnonzero(eigenvalues[:, 0] > 1e-9 * np.maximum(eigenvalues[:, -1], 1e-300))
    R_I_Q = so3.to_matrix(T_I_Q[usable, :4])
    J = np.zeros((len(usable), 6, 6))
    J[:, :3, :3] = J[:, 3:, 3:] = R_I_Q
    J[:, :3, 3:] = so3.skew(T_I_Q[usable, 4:]) @ R_I_Q
    R_M_I = so3.to_matrix(T_M_I[usable, :4])
    J[:, :3] = R_M_I @ J[:, :3]
    covariance = J @ np.linalg.inv(information[usable]) @ np.swapaxes(J, 1, 2)
    result[usable] = 0.5 * (covariance + np.swapaxes(covariance, 1, 2))
    return result


def _closure_options(options: CloudClosureOptions) -> LoopClosureOptions:
    """Return the thresholds that closures of clouds share with those of images."""
    return LoopClosureOptions(
        min_inlier_count=0,
        min_inlier_ratio=0.0,
        max_gravity_deviation_deg=options.max_gravity_deviation_deg,
        max_drift_ratio=options.max_drift_ratio,
        min_support=options.min_support,
    )


# Registration of clouds without an initial pose.
#
# Source: Lim et al., KISS-Matcher (ICRA 2025), the library kiss_matcher.

_VOXEL_RATIO = 3.0
"""Voxels of the matcher relative to those of the cloud."""
_MIN_INLIERS = 5


def register_globally(
    target: PreparedCloud, source: PreparedCloud, voxel_size_m: float
) -> F64 | None:
    """Return the approximate pose (7,) of a source cloud in a target cloud, None if there is none.

    Raises:
        UserError: kiss_matcher is not installed.
    """
    library = kiss_matcher()
    matcher = library.KISSMatcher(library.KISSMatcherConfig(_VOXEL_RATIO * voxel_size_m))
    result = matcher.estimate(source.p_S.astype(np.float32), target.p_S.astype(np.float32))
    if matcher.get_num_final_inliers() < _MIN_INLIERS:
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = np.asarray(result.rotation)
    matrix[:3, 3] = np.asarray(result.translation).reshape(3)
    return se3.from_matrix(matrix) if np.isfinite(matrix).all() else None


# Whether two registered clouds show the same surfaces: overlap, and points in space seen to be free.
#
# The rays of a cloud pass through free space up to its points. A point of the other cloud that lies in
# front of all neighbouring ones contradicts them; one behind them is hidden and says nothing.

_BIN_RAD = np.deg2rad(3.0)
"""Size of the bins of directions."""
_ROWS, _COLUMNS = round(np.pi / _BIN_RAD), round(2.0 * np.pi / _BIN_RAD)
_SURFACE_RANGE = 0.02
"""Points agree with a surface within this part of their range, and at least within ..."""
_SURFACE_M = 0.1
_NEAREST_M = 0.8
"""... if the surface has a point at this distance."""
_FREE_RANGE, _FREE_M = 0.05, 0.3
"""Points contradict if they are nearer than all around by this part of their range, and by this."""


@dataclasses.dataclass(frozen=True)
class Overlap:
    """Agreement of two clouds at a pose."""

    overlap: float  # share of the points on surfaces of the other cloud, of the cloud with less
    conflict: float  # share of the points in free space of the other, of the cloud with more
    compared: int  # points of the cloud with less overlap
    agreeing: int  # of these


def compare_clouds(target: PreparedCloud, source: PreparedCloud, T_T_S: F64) -> Overlap:
    """Return how far clouds agree at a pose (7,) of the source in the target."""
    ends = (
        _directed_overlap(target, source, T_T_S),
        _directed_overlap(source, target, se3.inverse(T_T_S)),
    )
    less = min(ends, key=lambda end: end[1] / end[0])
    conflict = max(end[2] / max(end[1] + end[2], 1) for end in ends)
    return Overlap(less[1] / less[0], conflict, less[0], less[1])


def _directed_overlap(
    seen: PreparedCloud, points: PreparedCloud, T_S_P: F64
) -> tuple[int, int, int]:
    """Return how many points there are, lie on seen surfaces, and lie in space seen to be free."""
    p, nearest, near = correspondences(seen, points, T_S_P, _NEAREST_M)
    range_m = np.linalg.norm(p, axis=1)
    distance = np.abs(np.einsum("ni,ni->n", seen.normal_S[nearest], p - seen.p_S[nearest]))
    on_surface = near & (distance <= np.maximum(_SURFACE_M, _SURFACE_RANGE * range_m))
    free_m = _free_ranges(seen.p_S)[_bins(p)]
    in_front = range_m + np.maximum(_FREE_M, _FREE_RANGE * range_m) < free_m
    return len(p), int(np.count_nonzero(on_surface)), int(np.count_nonzero(in_front & ~on_surface))


def _bins(p: F64) -> I64:
    """Return the bins (N,) of the directions to points (N, 3)."""
    elevation = np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) + 0.5 * np.pi
    azimuth = np.arctan2(p[:, 1], p[:, 0]) + np.pi
    row = np.minimum((elevation / _BIN_RAD).astype(np.int64), _ROWS - 1)
    column = np.minimum((azimuth / _BIN_RAD).astype(np.int64), _COLUMNS - 1)
    return np.asarray(row * _COLUMNS + column)


def _free_ranges(p: F64) -> F64:
    """Return up to which range (bins,) all points in and around a bin leave space free; 0 = unknown.

    A bin counts only if it and the bins on both sides of it along its row have points.
    """
    nearest = np.full(_ROWS * _COLUMNS, np.inf)
    np.minimum.at(nearest, _bins(p), np.linalg.norm(p, axis=1))
    image = nearest.reshape(_ROWS, _COLUMNS)
    has_points = np.isfinite(image)
    sides = [np.roll(image, shift, axis=1) for shift in (-1, 1)]
    known = has_points & np.isfinite(sides[0]) & np.isfinite(sides[1])
    free = np.minimum(image, np.minimum(*sides))
    padded = np.pad(free, ((1, 1), (0, 0)), constant_values=np.inf)
    free = np.minimum(free, np.minimum(padded[:-2], padded[2:]))
    return np.where(known, free, 0.0).reshape(-1)
