"""Anchor missions: align pairs, reject contradictions, grow a spanning tree, fit base frames.

The result depends neither on the order of the missions nor on which of them are known: all pairs
are aligned and compared first, the tree takes pairs in order of inliers, and the fit uses all pairs
that are consistent with the tree.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from maplab_py.algorithms.anchoring.absolute import (
    AbsoluteAnchoringOptions,
    anchor_by_absolute_poses,
)
from maplab_py.algorithms.anchoring.options import (
    AlignmentHypothesis,
    AnchoringOptions,
    AnchoringReport,
    MissionAlignment,
)
from maplab_py.algorithms.anchoring.pairs import (
    USED,
    Pair,
    align_pairs,
    consistent,
    fit_missions,
    fits,
    strongest_pairs,
)
from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.loop_closure import ambiguity, features, record_updates, workflow
from maplab_py.algorithms.loop_closure.detection import Detection, detect
from maplab_py.algorithms.loop_closure.mission_alignment import PairedClosures, ordered_by_mission
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import UserError
from maplab_py.geometry import yaw
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, mission_mask, to_hex

_DEFAULT = AnchoringOptions()
_ABSOLUTE = AbsoluteAnchoringOptions()
_LOOPS = LoopClosureOptions()
_NOTHING_KNOWN = (
    "no mission has a known base frame to anchor to; choose one with set_mission_baseframe_to_known"
)


def anchor_missions(
    vi_map: VIMap,
    options: AnchoringOptions = _DEFAULT,
    loop_options: LoopClosureOptions = _LOOPS,
    *,
    missions: I64 | None = None,
    choice: ambiguity.AlignmentChoice | None = None,
    absolute: AbsoluteAnchoringOptions = _ABSOLUTE,
    projections: features.ProjectionMemory | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, AnchoringReport]:
    """Anchor missions of unknown base frame by their absolute poses, then to those of known one.

    Landmarks, poses in mission frames and known base frames do not change. A mission
    without a trustworthy chain of alignments to a known mission stays unknown. The detected
    closures are recorded in the map, unless they anchored no mission.

    Args:
        loop_options: How places are recognised.
        missions: Mission rows to anchor; None = all unknown ones. Others may serve as bridges.
        choice: An alignment that a person has chosen; `options.hypothesis` is one, too.
        absolute: When the absolute poses of a mission count as agreeing.
        projections: Keeps the descriptor projection from one call to the next; None = it is learned.

    Raises:
        UserError: The chosen alignment does not exist.
        EstimationError: No descriptors, or too few tracks to learn their projection.
    """
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    wanted = mission_mask(vi_map, missions) & ~known
    vi_map, measured, refused = anchor_by_absolute_poses(vi_map, wanted, absolute)
    by_poses = tuple(names[i] for i in np.flatnonzero(measured))
    report = AnchoringReport(
        already_known=tuple(names[i] for i in np.flatnonzero(known)),
        anchored=by_poses,
        not_anchored={},
        alignments=(),
        by_absolute_poses=by_poses,
        notes=tuple(f"{names[i]}: {reason}" for i, reason in refused.items()),
    )
    known, wanted = known | measured, wanted & ~measured
    if not known.any() or not wanted.any():
        idle = () if wanted.any() or by_poses else ("all base frames are known already",)
        reason = "" if known.any() else _NOTHING_KNOWN
        return vi_map, dataclasses.replace(report, notes=report.notes or idle, reason=reason)
    if options.hypothesis:
        choice = ambiguity.AlignmentChoice(options.hypothesis)
    judged, notes = evaluate_unknown_quality(vi_map, progress)
    detection = detect(
        judged,
        loop_options,
        missions=np.arange(len(judged.missions)),
        only_other_missions=True,
        trust_base_frames=False,
        choice=choice,
        scope=features.SearchScope(projections=projections),
        progress=progress,
    )
    T_G_M, reached, pairs = _align(judged, known, detection, options, names)
    alignments = [_describe(pair, names) for pair in pairs]
    anchored = reached & wanted
    report = dataclasses.replace(
        report,
        anchored=(*by_poses, *(names[i] for i in np.flatnonzero(anchored))),
        not_anchored={
            names[i]: _why_not(i, names, alignments, judged, detection, loop_options)
            for i in np.flatnonzero(wanted & ~reached)
        },
        alignments=tuple(alignments),
        hypotheses=described_hypotheses(detection.contests, names),
        notes=(*report.notes, *notes),
    )
    if not anchored.any():
        return vi_map, report
    result = _with_base_frames(vi_map, anchored, T_G_M[anchored])
    return record_updates.with_closures(result, detection.closures, "anchor"), report


def _describe(pair: Pair, names: list[str]) -> MissionAlignment:
    return MissionAlignment(
        missions=f"{names[pair.a]} - {names[pair.b]}",
        closures=pair.closures,
        agreeing=len(pair.sightings.weight),
        rms_m=pair.rms_m,
        verdict=pair.verdict,
    )


def _sightings(vi_map: VIMap, detection: Detection) -> PairedClosures:
    """Return the accepted closures with the smaller mission row as A, whichever was the query."""
    c = detection.closures
    c = c.take(c.accepted)
    mission = vi_map.vertices.mission.astype(np.int64)
    ends = mission[c.query_vertex], mission[c.place_vertex]
    columns = ordered_by_mission(ends, (vi_map.vertices.T_M_I[c.query_vertex], c.T_M_I))
    return PairedClosures(c.inliers.astype(np.float64), *columns)


def _align(
    vi_map: VIMap,
    known: NDArray[np.bool_],
    detection: Detection,
    options: AnchoringOptions,
    names: list[str],
) -> tuple[F64, NDArray[np.bool_], list[Pair]]:
    """Align the strongest pairs, grow the tree, and fit; align all pairs if a mission is not reached."""
    start, sightings = yaw.from_pose(vi_map.T_G_M), _sightings(vi_map, detection)
    undecided = {c.pair.missions: c.reason for c in detection.contests if c.winner < 0}
    wanted = strongest_pairs(sightings, len(known))
    pairs = align_pairs(sightings, undecided, options, wanted)
    T_G_M, reached, pairs = _spread(start, known, consistent(pairs, options, names), options)
    joined = np.unique(np.concatenate([sightings.mission_A, sightings.mission_B]))
    is_complete = len(wanted) == len(sightings.rows_of_pairs())
    if not (is_complete or reached[joined].all()):
        pairs = consistent(align_pairs(sightings, undecided, options), options, names)
        T_G_M, reached, pairs = _spread(start, known, pairs, options)
    used = [p.sightings for p in pairs if p.verdict == USED and reached[p.a] and reached[p.b]]
    if used:
        T_G_M = fit_missions(PairedClosures.concatenate(used), T_G_M, known | ~reached)
    return T_G_M, reached, pairs


def _spread(
    T_G_M: F64, known: NDArray[np.bool_], pairs: list[Pair], options: AnchoringOptions
) -> tuple[F64, NDArray[np.bool_], list[Pair]]:
    """Grow a maximum spanning tree from the known missions (Prim), or a star around each of them.

    Returns:
        The poses of the missions, a mask of reached missions, and the pairs; pairs that contradict
        the tree over a longer cycle are marked as such.
    """
    T_G_M, reached = T_G_M.copy(), known.copy()
    # what others may be anchored to: everything in the tree, or the known missions only
    base = reached if options.add_to_database else known
    ranked = sorted((p for p in pairs if p.verdict == USED), key=lambda p: -p.weight)
    while True:
        bridge = next(
            (p for p in ranked if reached[p.a] != reached[p.b] and (base[p.a] or base[p.b])), None
        )
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
    """Reject a pair that contradicts the poses of its missions in the tree."""
    if pair.verdict != USED or not (reached[pair.a] and reached[pair.b]):
        return pair
    T_B_A = yaw.compose(yaw.inverse(T_G_M[pair.b]), T_G_M[pair.a])
    if fits(pair, T_B_A, options):
        return pair
    return dataclasses.replace(pair, verdict="contradicts stronger alignments")


def _why_not(  # type: ignore[no-untyped-def]
    mission, names, alignments, vi_map, detection, loop_options
) -> str:
    mine = [a for a in alignments if names[mission] in a.missions]
    tried = [f"{a.missions}: {a.verdict}" for a in mine if a.verdict != USED]
    if tried:
        return "; ".join(tried)
    if mine:
        return "aligned only with missions that are not anchored themselves"
    report = workflow.describe(vi_map, detection, loop_options)
    return report.reason or "no verified closure with any other mission"


def _with_base_frames(vi_map: VIMap, missions: NDArray[np.bool_] | int, T_G_M: F64) -> VIMap:
    rows, poses = vi_map.missions.baseframe[missions], yaw.to_pose(T_G_M)
    return vi_map.replace(baseframes=vi_map.baseframes.put(rows, T_G_M=poses, is_known=True))


def described_hypotheses(
    contests: Sequence[ambiguity.Contest], names: Sequence[str]
) -> tuple[AlignmentHypothesis, ...]:
    """Describe the alignments of all pairs of missions that have several or none that wins."""
    return tuple(
        _describe_hypothesis(number, contests[i], k, names)
        for number, (i, k) in enumerate(ambiguity.listed_alignments(contests), start=1)
    )


def _describe_hypothesis(
    number: int, contest: ambiguity.Contest, k: int, names: Sequence[str]
) -> AlignmentHypothesis:
    alignments = contest.pair.alignments
    alignment = alignments[k]
    only_this = [len(alignment.stretches_A), len(alignment.stretches_B)]
    if len(alignments) > 1:
        rival = alignments[0 if k else 1]
        only_this = [
            len(np.setdiff1d(alignment.stretches(side), rival.stretches(side))) for side in (0, 1)
        ]
    a, b = contest.pair.missions
    x, y, z, yaw_rad = (float(value) for value in alignment.T_B_A)
    return AlignmentHypothesis(
        number=number,
        missions=f"{names[a]} - {names[b]}",
        closures=len(alignment.rows),
        stretches=(len(alignment.stretches_A), len(alignment.stretches_B)),
        only_this=(only_this[0], only_this[1]),
        position_m=(x, y, z),
        yaw_deg=float(np.degrees(yaw_rad)),
        outcome=_outcome(contest, k),
    )


def _outcome(contest: ambiguity.Contest, k: int) -> str:
    if contest.winner < 0:
        return "undecided"
    if k == contest.winner:
        return "wins"
    return "runner-up" if k == (1 if contest.winner == 0 else 0) else "loses"


def place_mission(vi_map: VIMap, mission: int, T_G_M: F64) -> tuple[VIMap, AnchoringReport]:
    """Make the base frame of a mission known at a pose (4,): position and yaw.

    Raises:
        UserError: The base frame is known already.
    """
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    _require_unknown(vi_map, mission)
    names = [to_hex(words)[:8] for words in vi_map.missions.id]
    report = AnchoringReport(
        already_known=tuple(names[i] for i in np.flatnonzero(known)),
        anchored=(names[mission],),
        not_anchored={},
        alignments=(),
        notes=("the base frame was given and not compared with closures",),
    )
    return _with_base_frames(vi_map, mission, T_G_M), report


def choice_near(vi_map: VIMap, mission: int, to: int, T_G_M: F64) -> ambiguity.AlignmentChoice:
    """Return the choice of the alignment of two missions that is near a pose (4,) of the first.

    Raises:
        UserError: The mission's base frame is known already, or that of the other is not.
    """
    _require_unknown(vi_map, mission)
    if not vi_map.baseframes.is_known[vi_map.missions.baseframe[to]]:
        name = to_hex(vi_map.missions.id[to])[:8]
        raise UserError(
            f"--to={name}: its base frame is unknown; name a mission of known base frame"
        )
    T_G_to = yaw.from_pose(vi_map.T_G_M)[to]
    T_to_M = yaw.compose(yaw.inverse(T_G_to), T_G_M)
    if mission < to:
        return ambiguity.AlignmentChoice(missions=(mission, to), T_B_A=T_to_M)
    return ambiguity.AlignmentChoice(missions=(to, mission), T_B_A=yaw.inverse(T_to_M))


def _require_unknown(vi_map: VIMap, mission: int) -> None:
    if vi_map.baseframes.is_known[vi_map.missions.baseframe[mission]]:
        name = to_hex(vi_map.missions.id[mission])[:8]
        raise UserError(
            f"the base frame of mission {name} is known already; make it unknown first "
            "(set_mission_baseframe_to_unknown)"
        )
