"""Find loop closures between the clouds of a map and add them as edges."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.cloud_registration.candidates import (
    CloudPairs,
    pairs_by_position,
    pairs_everywhere,
    pairs_from_closures,
)
from maplab_py.algorithms.cloud_registration.options import (
    CloudClosureOptions,
    CloudClosureReport,
)
from maplab_py.algorithms.cloud_registration.scans import Scans, map_scans
from maplab_py.algorithms.cloud_registration.search import (
    CloudMatches,
    judge_matches,
    register_pairs,
)
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.edges import closure_edges
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import with_closures
from maplab_py.algorithms.loop_closure.workflow import missions_joined
from maplab_py.array_types import I64
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LoopClosureEdges, VIMap
from maplab_py.vimap.ids import IdIndex


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
        vi_map: The map.
        map_folder: Folder of the map, for its resources.
        options: Candidates, registration and gates.
        missions: Missions (rows); None = all.
        progress: Is told about every pair.

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
    edges = closure_edges(
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
    result = with_closures(result, closures, "edge", used=used)
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
    closures: Closures,
    edges: int,
) -> CloudClosureReport:
    accepted = closures.accepted
    report = CloudClosureReport(
        clouds=len(scans),
        pairs=len(pairs),
        accepted=int(np.count_nonzero(accepted)),
        edges_added=edges,
        refused=closures.refused_by_reason(),
        missions_joined=missions_joined(vi_map, closures),
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
