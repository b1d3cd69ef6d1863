"""Close loops by merging landmarks, or describe them as edges of the pose graph."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.loop_closure import merging
from maplab_py.algorithms.loop_closure.closures import Closures
from maplab_py.algorithms.loop_closure.detection import Detection, detect
from maplab_py.algorithms.loop_closure.edges import closure_edges
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.recording import with_closures
from maplab_py.algorithms.loop_closure.report import LoopClosureReport
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, LoopClosureEdges, VIMap
from maplab_py.vimap.ids import IdIndex, to_hex

I64 = NDArray[np.int64]

_DEFAULT = LoopClosureOptions()


@dataclasses.dataclass(frozen=True, eq=False)
class LoopSearch:
    """Closures of a map, accepted and refused, and the edges of the accepted ones."""

    closures: Closures
    edges: LoopClosureEdges


def close_loops(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoopClosureReport]:
    """Find loop closures and merge the landmarks that are one point.

    The map's record gets every closure with its verdict, and every merge.

    Args:
        vi_map: The map; landmarks of unknown quality are judged first.
        options: Thresholds.
        missions: Mission rows, None for all.
        progress: Progress.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    judged, notes = with_quality(vi_map, progress)
    detection = _detect(judged, options, missions, progress)
    closures = detection.closures
    merged, result = merging.merge_verified_landmarks(judged, closures, options)
    used = np.zeros(len(closures), dtype=np.bool_)
    used[result.closure] = True
    recorded = with_closures(merged, closures, "merge", used=used, merges=result, before=judged)
    report = dataclasses.replace(
        describe(judged, detection, options, notes),
        landmarks_merged=result.landmarks_merged,
        observations_moved=result.observations_moved,
        merges_refused=result.refused,
    )
    if merging.GAP in result.refused:
        open_ = closures.accepted & (closures.correction_m > options.max_merge_gap_m)
        remedy = (
            f"{np.count_nonzero(open_)} closures correct up to {report.largest_correction_m:.2f} "
            f"m, more than --lc_max_merge_gap_m={options.max_merge_gap_m:g}; run relax first"
        )
        report = dataclasses.replace(report, notes=(*report.notes, remedy))
    if not report.reason and result.landmarks_merged == 0 and result.refused:
        reasons = "; ".join(f"{why} ({n})" for why, n in result.refused.items())
        reason = report.notes[-1] if merging.GAP in result.refused else reasons
        report = dataclasses.replace(report, reason=f"no landmarks merged: {reason}")
    return recorded, report


def search_loops(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[LoopSearch, LoopClosureReport]:
    """Find loop closures; change nothing.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    judged, notes = with_quality(vi_map, progress)
    detection = _detect(judged, options, missions, progress)
    edges = closure_edges(detection.closures, options)
    report = describe(judged, detection, options, notes)
    report = dataclasses.replace(report, edges_added=len(edges))
    if not report.reason and len(edges) == 0:
        report = dataclasses.replace(
            report,
            reason=f"no edges: the closures correct at most {report.largest_correction_m:.3f} m, "
            f"less than --lc_edge_min_distance_meters={options.edge_min_distance_meters:g}",
        )
    return LoopSearch(detection.closures, edges), report


def find_loop_closures(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[LoopClosureEdges, LoopClosureReport]:
    """Find loop closures and return them as edges from query to place, for the pose graph.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    search, report = search_loops(vi_map, options, missions=missions, progress=progress)
    return search.edges, report


def insert_edges(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoopClosureReport]:
    """Find loop closures and append them to the map as edges; landmarks stay as they are.

    An edge between the same two vertices that an earlier search made is replaced.
    """
    search, report = search_loops(vi_map, options, missions=missions, progress=progress)
    edges = search.edges
    old = vi_map.loop_closure_edges
    kept = IdIndex(edges.id).rows(old.id) < 0
    table = LoopClosureEdges.concatenate([old.take(kept), edges])
    used = IdIndex(edges.id).rows(search.closures.id) >= 0
    result = vi_map.replace(loop_closure_edges=table)
    result = with_closures(result, search.closures, "edge", used=used & search.closures.accepted)
    return result, report


def with_quality(vi_map: VIMap, progress: Progress = SILENT) -> tuple[VIMap, tuple[str, ...]]:
    """Judge landmarks of unknown quality, and say so; judged ones keep their verdict."""
    unknown = vi_map.landmarks.quality == LandmarkQuality.UNKNOWN
    if not unknown.any():
        return vi_map, ()
    judged, _ = evaluate_quality(vi_map, LandmarkQualityOptions(), progress=progress)
    quality = np.where(unknown, judged.landmarks.quality, vi_map.landmarks.quality)
    judged = vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality))
    return judged, (f"evaluated the quality of {np.count_nonzero(unknown)} landmarks first",)


def _detect(
    vi_map: VIMap, options: LoopClosureOptions, missions: I64 | None, progress: Progress
) -> Detection:
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    return detect(
        vi_map,
        options,
        missions=rows,
        only_other_missions=options.only_against_other_missions,
        progress=progress,
    )


def describe(
    vi_map: VIMap, detection: Detection, options: LoopClosureOptions, notes: tuple[str, ...] = ()
) -> LoopClosureReport:
    """Summarise a detection; nothing accepted is explained by the distance to the gates."""
    closures = detection.closures
    accepted = closures.accepted
    correction = closures.correction_m[accepted]
    return LoopClosureReport(
        query_vertices=detection.query_vertices,
        database_landmarks=detection.database_landmarks,
        descriptor_matches=detection.descriptor_matches,
        candidates=len(closures),
        accepted=int(np.count_nonzero(accepted)),
        accepted_vertices=len(np.unique(closures.query_vertex[accepted])),
        refused=closures.refused_by_reason(),
        missions_joined=_joined(vi_map, closures),
        largest_correction_m=float(correction.max(initial=0.0)),
        median_correction_m=float(np.median(correction)) if len(correction) else 0.0,
        notes=(*notes, *detection.notes),
        reason="" if accepted.any() else _explanation(detection, options),
    )


def _joined(vi_map: VIMap, closures: Closures) -> tuple[str, ...]:
    """Count accepted closures by pair of missions."""
    rows = np.flatnonzero(closures.accepted)
    mission = vi_map.vertices.mission
    ends = np.stack([mission[closures.query_vertex[rows]], mission[closures.place_vertex[rows]]])
    pairs, count = np.unique(np.sort(ends, axis=0), axis=1, return_counts=True)
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    return tuple(f"{names[a]} - {names[b]}: {n}" for (a, b), n in zip(pairs.T, count, strict=True))


def _explanation(detection: Detection, options: LoopClosureOptions) -> str:
    """Say how far the best candidates were from each gate."""
    c = detection.closures
    if detection.database_landmarks == 0:
        return "no loop closures: no landmark is good and has two observations with descriptors"
    if len(c) == 0:
        return (
            f"no loop closures: of {detection.descriptor_matches} descriptor matches no place got "
            f"--lc_min_verify_matches_num={options.min_verify_matches_num} from one vertex "
            "(landmarks that are one already are not matched)"
        )
    best = int(np.argmax(c.inlier_count))
    ratio = c.inlier_count / np.maximum(c.match_count, 1)
    refused = ", ".join(f"{why}: {n}" for why, n in c.refused_by_reason().items())
    return (
        f"no loop closures: best of {len(c)} candidates has {c.inlier_count[best]} inliers (wanted "
        f"{options.min_inlier_count}), ratio {ratio[best]:.2f} (wanted "
        f"{options.min_inlier_ratio:g}), tilt {c.tilt_deg[best]:.1f} deg, {c.support[best]} "
        f"supporters (wanted {options.min_support}), correction {c.correction_m[best]:.2f} m; "
        f"refused: {refused}"
    )
