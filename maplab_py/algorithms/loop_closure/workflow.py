"""Close loops by merging landmarks or by adding edges to the pose graph."""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.loop_closure import features, merging
from maplab_py.algorithms.loop_closure.closure_table import Closures, closure_edges
from maplab_py.algorithms.loop_closure.detection import Detection, detect
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import with_closures
from maplab_py.algorithms.loop_closure.reports import GAP, LoopClosureReport
from maplab_py.array_types import I64, mask_of
from maplab_py.distinct import distinct
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.vimap import IdIndex, LoopClosureEdges, VIMap, to_hex

_DEFAULT = LoopClosureOptions()
_EVERYTHING = features.SearchScope()


@dataclasses.dataclass(frozen=True, eq=False)
class LoopSearch:
    """Accepted and rejected closures of a map, and edges of the accepted ones."""

    closures: Closures
    edges: LoopClosureEdges


def close_loops(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    scope: features.SearchScope = _EVERYTHING,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoopClosureReport]:
    """Find loop closures and merge landmarks of the same point.

    Every closure with its verdict and every merge is recorded in the map.

    Args:
        vi_map: The map; the quality of landmarks is evaluated first where it is unknown.
        scope: What is left out.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    judged, notes = evaluate_unknown_quality(vi_map, progress)
    detection = _detect(judged, options, missions, progress, scope)
    closures = detection.closures
    merged, result = merging.merge_verified_landmarks(judged, closures, options)
    used = mask_of(len(closures), result.closure)
    recorded = with_closures(merged, closures, "merge", used=used, merges=result, before=judged)
    report = dataclasses.replace(
        describe(judged, detection, options, notes),
        landmarks_merged=result.landmarks_merged,
        observations_moved=result.observations_moved,
        merges_refused=result.refused,
    )
    if GAP in result.refused:
        open_ = closures.accepted & (closures.correction_m > options.max_merge_gap_m)
        remedy = (
            f"{counted(int(np.count_nonzero(open_)), 'closure')} with a correction of up to "
            f"{report.largest_correction_m:.2f} m, more than "
            f"--lc_max_merge_gap_m={options.max_merge_gap_m:g}; run relax first"
        )
        report = dataclasses.replace(report, notes=(*report.notes, remedy))
    if not report.reason and result.landmarks_merged == 0 and result.refused:
        reasons = "; ".join(f"{why} ({n})" for why, n in result.refused.items())
        reason = report.notes[-1] if GAP in result.refused else reasons
        report = dataclasses.replace(report, reason=f"no landmarks merged: {reason}")
    return recorded, report


def search_loops(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[LoopSearch, LoopClosureReport]:
    """Find loop closures without changing the map.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    judged, notes = evaluate_unknown_quality(vi_map, progress)
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


def insert_edges(
    vi_map: VIMap,
    options: LoopClosureOptions = _DEFAULT,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoopClosureReport]:
    """Find loop closures and append them to the map as edges; landmarks do not change.

    An edge of an earlier search between the same two vertices is replaced.
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


def _detect(
    vi_map: VIMap,
    options: LoopClosureOptions,
    missions: I64 | None,
    progress: Progress,
    scope: features.SearchScope = _EVERYTHING,
) -> Detection:
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    return detect(
        vi_map,
        options,
        missions=rows,
        only_other_missions=options.only_against_other_missions,
        scope=scope,
        progress=progress,
    )


def describe(
    vi_map: VIMap, detection: Detection, options: LoopClosureOptions, notes: tuple[str, ...] = ()
) -> LoopClosureReport:
    """Summarise a detection; without accepted closures, report the distance to the gates."""
    closures = detection.closures
    accepted = closures.accepted
    correction = closures.correction_m[accepted]
    return LoopClosureReport(
        query_vertices=detection.query_vertices,
        database_landmarks=detection.database_landmarks,
        descriptor_matches=detection.descriptor_matches,
        candidates=len(closures),
        accepted=int(np.count_nonzero(accepted)),
        accepted_vertices=len(distinct(closures.query_vertex[accepted])),
        refused=closures.refused_by_reason(),
        missions_joined=missions_joined(vi_map, closures),
        largest_correction_m=float(correction.max(initial=0.0)),
        median_correction_m=float(np.median(correction)) if len(correction) else 0.0,
        notes=(*notes, *detection.notes),
        reason="" if accepted.any() else _explanation(detection, options),
    )


def missions_joined(vi_map: VIMap, closures: Closures) -> tuple[str, ...]:
    """Return accepted closures by pair of missions: "short id - short id: closures"."""
    rows = np.flatnonzero(closures.accepted)
    mission = vi_map.vertices.mission
    ends = np.stack([mission[closures.query_vertex[rows]], mission[closures.place_vertex[rows]]])
    pairs, count = np.unique(np.sort(ends, axis=0), axis=1, return_counts=True)
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    return tuple(f"{names[a]} - {names[b]}: {n}" for (a, b), n in zip(pairs.T, count, strict=True))


def _explanation(detection: Detection, options: LoopClosureOptions) -> str:
    """Return how far the best candidates were from each gate."""
    c = detection.closures
    if detection.database_landmarks == 0:
        return "no loop closures: no landmark is good and has two observations with descriptors"
    if len(c) == 0:
        return (
            f"no loop closures: of {detection.descriptor_matches} descriptor matches no place got "
            f"--lc_min_verify_matches_num={options.min_verify_matches_num} from one vertex "
            "(merged landmarks are not matched)"
        )
    best = int(np.argmax(c.inliers))
    ratio = c.inliers / np.maximum(c.matches, 1)
    refused = ", ".join(f"{why}: {n}" for why, n in c.refused_by_reason().items())
    return (
        f"no loop closures: best of {len(c)} candidates has {c.inliers[best]} inliers (needed "
        f"{options.inlier_factor * options.min_inlier_count:g}), ratio {ratio[best]:.2f} (needed "
        f"{options.min_inlier_ratio:g}), tilt {c.tilt_deg[best]:.1f} deg, {c.support[best]} "
        f"supporters (needed {options.min_support}), correction {c.correction_m[best]:.2f} m; "
        f"refused: {refused}"
    )
