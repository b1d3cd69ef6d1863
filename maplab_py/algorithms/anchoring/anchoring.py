"""Anchor missions: align all pairs, drop contradictions, grow the best tree, fit the base frames.

The result depends neither on the order of missions nor on which are known: all pairs are aligned
and compared first, the tree takes those with most inliers first, the fit takes all that fit it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.anchoring.alignment import Sightings, fit_missions
from maplab_py.algorithms.anchoring.options import (
    AnchoringOptions,
    AnchoringReport,
    MissionAlignment,
)
from maplab_py.algorithms.anchoring.pairs import USED, Pair, align_pairs, consistent, fits
from maplab_py.algorithms.loop_closure.closing import describe, with_quality
from maplab_py.algorithms.loop_closure.closures import VERDICTS
from maplab_py.algorithms.loop_closure.detection import Detection, detect
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.recording import with_closures
from maplab_py.algorithms.loop_closure.report import Verdict
from maplab_py.geometry import yaw
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_DEFAULT = AnchoringOptions()
_LOOPS = LoopClosureOptions()


def anchor_missions(
    vi_map: VIMap,
    options: AnchoringOptions = _DEFAULT,
    loop_options: LoopClosureOptions = _LOOPS,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, AnchoringReport]:
    """Anchor missions of unknown base frame to those of known one.

    Landmarks, poses in the missions' own frames and known base frames stay as they are. A mission
    without a trustworthy chain of alignments to a known mission stays unknown.

    Args:
        vi_map: The map.
        options: When missions count as aligned.
        loop_options: How places are recognised.
        missions: Mission rows to anchor; None = all unknown ones. Others may serve as bridges.
        progress: Progress.

    Raises:
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    wanted = ~known
    if missions is not None:
        wanted = np.zeros(len(known), dtype=np.bool_)
        wanted[missions] = True
        wanted &= ~known
    if not known.any() or not wanted.any():
        return vi_map, _nothing_to_do(names, known, wanted)
    judged, notes = with_quality(vi_map, progress)
    detection = detect(
        judged,
        loop_options,
        missions=np.arange(len(known)),
        only_other_missions=True,
        trust_base_frames=False,
        progress=progress,
    )
    pairs = align_pairs(_sightings(judged, detection), _looks_alike(judged, detection), options)
    pairs = consistent(pairs, options, names)
    T_G_M, reached, pairs = _spread(yaw.from_pose(vi_map.T_G_M), known, pairs, options)
    used = [p.sightings for p in pairs if p.verdict == USED and reached[p.a] and reached[p.b]]
    if used:
        T_G_M = fit_missions(_joined(used), T_G_M, known | ~reached)
    alignments = [_described(pair, names) for pair in pairs]
    anchored = reached & wanted
    report = AnchoringReport(
        already_known=tuple(names[i] for i in np.flatnonzero(known)),
        anchored=tuple(names[i] for i in np.flatnonzero(anchored)),
        not_anchored={
            names[i]: _why_not(i, names, alignments, judged, detection, loop_options)
            for i in np.flatnonzero(wanted & ~reached)
        },
        alignments=tuple(alignments),
        notes=notes,
    )
    result = _with_base_frames(vi_map, T_G_M, anchored)
    return with_closures(result, detection.closures, "anchor"), report


def _nothing_to_do(
    names: list[str], known: NDArray[np.bool_], wanted: NDArray[np.bool_]
) -> AnchoringReport:
    reason = ""
    if not known.any():
        reason = (
            "no mission has a known base frame to anchor to; choose one with "
            "set_mission_baseframe_to_known"
        )
    return AnchoringReport(
        already_known=tuple(names[i] for i in np.flatnonzero(known)),
        anchored=(),
        not_anchored={},
        alignments=(),
        notes=() if wanted.any() else ("all base frames are known already",),
        reason=reason,
    )


def _described(pair: Pair, names: list[str]) -> MissionAlignment:
    return MissionAlignment(
        missions=f"{names[pair.a]} - {names[pair.b]}",
        closures=pair.closures,
        agreeing=len(pair.sightings.weight),
        rms_m=pair.rms_m,
        verdict=pair.verdict,
    )


def _looks_alike(vi_map: VIMap, detection: Detection) -> I64:
    """Count closures (M, M; upper triangle) that were refused since places look alike."""
    c = detection.closures
    rows = np.flatnonzero(c.verdict == VERDICTS.index(Verdict.AMBIGUOUS))
    ends = np.stack([c.query_vertex[rows], c.place_vertex[rows]])
    pair = np.sort(vi_map.vertices.mission[ends], axis=0)
    count = np.zeros((len(vi_map.missions),) * 2, dtype=np.int64)
    np.add.at(count, (pair[0], pair[1]), 1)
    return count


def _sightings(vi_map: VIMap, detection: Detection) -> Sightings:
    """Return the accepted closures with the smaller mission row as A, whichever was the query."""
    c = detection.closures
    rows = np.flatnonzero(c.accepted)
    query, place = c.query_vertex[rows], c.place_vertex[rows]
    mission = vi_map.vertices.mission.astype(np.int64)
    T_A_I, T_B_I = vi_map.vertices.T_M_I[query].copy(), c.T_M_I[rows].copy()
    A, B = mission[query], mission[place]
    swapped = A > B
    T_A_I[swapped], T_B_I[swapped] = T_B_I[swapped], T_A_I[swapped]
    return Sightings(
        mission_A=np.minimum(A, B),
        mission_B=np.maximum(A, B),
        T_A_I=T_A_I,
        T_B_I=T_B_I,
        weight=c.inlier_count[rows].astype(np.float64),
    )


def _spread(
    T_G_M: F64, known: NDArray[np.bool_], pairs: list[Pair], options: AnchoringOptions
) -> tuple[F64, NDArray[np.bool_], list[Pair]]:
    """Grow a maximum spanning tree from the known missions (Prim).

    Returns:
        Where the missions are, which are reached, and the pairs: those that contradict the tree
        over a longer cycle have that as their verdict.
    """
    T_G_M, reached = T_G_M.copy(), known.copy()
    ranked = sorted((p for p in pairs if p.verdict == USED), key=lambda p: -p.weight)
    while True:
        bridge = next((p for p in ranked if reached[p.a] != reached[p.b]), None)
        if bridge is None:
            break
        if reached[bridge.b]:
            T_G_M[bridge.a] = yaw.compose(T_G_M[bridge.b], bridge.T_B_A)
        else:
            T_G_M[bridge.b] = yaw.compose(T_G_M[bridge.a], yaw.inverse(bridge.T_B_A))
        reached[bridge.a] = reached[bridge.b] = True
    checked = [_against_tree(p, T_G_M, reached, options) for p in pairs]
    return T_G_M, reached, checked


def _against_tree(
    pair: Pair, T_G_M: F64, reached: NDArray[np.bool_], options: AnchoringOptions
) -> Pair:
    """Refuse a pair that does not fit where the tree put its missions."""
    if pair.verdict != USED or not (reached[pair.a] and reached[pair.b]):
        return pair
    T_B_A = yaw.compose(yaw.inverse(T_G_M[pair.b]), T_G_M[pair.a])
    if fits(pair, T_B_A, options):
        return pair
    return dataclasses.replace(pair, verdict="contradicts stronger alignments")


def _joined(parts: list[Sightings]) -> Sightings:
    return Sightings(
        *(
            np.concatenate([getattr(part, field.name) for part in parts])
            for field in dataclasses.fields(Sightings)
        )
    )


def _why_not(  # type: ignore[no-untyped-def]
    mission, names, alignments, vi_map, detection, loop_options
) -> str:
    mine = [a for a in alignments if names[mission] in a.missions]
    tried = [f"{a.missions}: {a.verdict}" for a in mine if a.verdict != USED]
    if tried:
        return "; ".join(tried)
    if mine:
        return "aligned only with missions that are not anchored themselves"
    report = describe(vi_map, detection, loop_options)
    return report.reason or "no verified closure with any other mission"


def _with_base_frames(vi_map: VIMap, T_G_M: F64, anchored: NDArray[np.bool_]) -> VIMap:
    rows = vi_map.missions.baseframe[anchored]
    poses, is_known = vi_map.baseframes.T_G_M.copy(), vi_map.baseframes.is_known.copy()
    poses[rows], is_known[rows] = yaw.to_pose(T_G_M[anchored]), True
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=poses, is_known=is_known))
