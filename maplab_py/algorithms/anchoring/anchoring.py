"""Anchor missions: align all pairs, keep the best tree, fit the base frames to all closures.

The result does not depend on the order of missions: all pairs are aligned first, and the tree that
starts from the known missions takes the pairs with most inliers first.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.anchoring.alignment import Sightings, agreeing, fit_missions
from maplab_py.algorithms.anchoring.options import (
    AnchoringOptions,
    AnchoringReport,
    MissionAlignment,
)
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Pair:
    """An accepted alignment of two missions."""

    a: int
    b: int
    T_B_A: F64  # yaw and position (4,)
    weight: float
    sightings: Sightings


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
        known_base_frames=False,
        progress=progress,
    )
    pairs, alignments = _aligned_pairs(judged, detection, options, names)
    T_G_M, reached = _spread(yaw.from_pose(vi_map.T_G_M), known, pairs)
    used = [p.sightings for p in pairs if reached[p.a] and reached[p.b]]
    if used:
        T_G_M = fit_missions(_joined(used), T_G_M, known | ~reached)
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


def _aligned_pairs(
    vi_map: VIMap, detection: Detection, options: AnchoringOptions, names: list[str]
) -> tuple[list[_Pair], list[MissionAlignment]]:
    """Align every pair of missions that closures join."""
    all_ = _sightings(vi_map, detection)
    unclear = _ambiguous_counts(vi_map, detection)
    pairs: list[_Pair] = []
    alignments: list[MissionAlignment] = []
    for a, b in np.unique(np.stack([all_.mission_A, all_.mission_B], axis=1), axis=0).tolist():
        between = all_.take((all_.mission_A == a) & (all_.mission_B == b))
        T_B_A, agree = agreeing(between, options)
        good = between.take(agree)
        single = np.array([[0.0, 0.0, 0.0, 0.0], T_B_A])
        local = dataclasses.replace(
            good, mission_A=np.ones_like(good.mission_A), mission_B=np.zeros_like(good.mission_B)
        )
        T_B_A = fit_missions(local, single, np.array([True, False]))[1]
        gap = yaw.transform(T_B_A, good.T_A_I[:, 4:]) - good.T_B_I[:, 4:]
        count, agreed = len(agree), int(np.count_nonzero(agree))
        verdict = "used"
        if unclear[a, b] > options.max_ambiguous_ratio * agreed:
            verdict = (
                f"{unclear[a, b]} closures with places that look like other places, {agreed} "
                f"without; more than --anchor_transform_max_ambiguous_ratio="
                f"{options.max_ambiguous_ratio:g}"
            )
        elif agreed < options.min_inlier_count:
            verdict = f"{agreed} closures agree, {options.min_inlier_count} are wanted"
        elif agreed < options.min_inlier_ratio * count:
            verdict = f"only {agreed} of {count} closures agree"
        else:
            pairs.append(_Pair(a, b, T_B_A, float(good.weight.sum()), good))
        alignments.append(
            MissionAlignment(
                missions=f"{names[a]} - {names[b]}",
                closures=count,
                agreeing=agreed,
                rms_m=float(np.sqrt(np.mean(np.sum(gap**2, axis=1)))),
                verdict=verdict,
            )
        )
    return pairs, alignments


def _ambiguous_counts(vi_map: VIMap, detection: Detection) -> I64:
    """Count closures (M, M) between missions that were refused since places look alike."""
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
    T_G_M: F64, known: NDArray[np.bool_], pairs: list[_Pair]
) -> tuple[F64, NDArray[np.bool_]]:
    """Grow a maximum spanning tree from the known missions (Prim); return places and who is reached."""
    T_G_M, reached = T_G_M.copy(), known.copy()
    ranked = sorted(pairs, key=lambda p: -p.weight)
    while True:
        bridge = next((p for p in ranked if reached[p.a] != reached[p.b]), None)
        if bridge is None:
            return T_G_M, reached
        if reached[bridge.b]:
            T_G_M[bridge.a] = yaw.compose(T_G_M[bridge.b], bridge.T_B_A)
        else:
            T_G_M[bridge.b] = yaw.compose(T_G_M[bridge.a], yaw.inverse(bridge.T_B_A))
        reached[bridge.a] = reached[bridge.b] = True


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
    tried = [f"{a.missions}: {a.verdict}" for a in mine if a.verdict != "used"]
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
