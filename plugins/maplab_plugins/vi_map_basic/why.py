"""Explanations of refused closures, unjoined missions and bad landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.plugin import CommandContext, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.landmarks.quality import LandmarkExplanation
    from maplab_py.algorithms.loop_closure.explanation import (
        ClosureExplanation,
        MissionExplanation,
        PairExplanation,
    )
    from maplab_py.console.session.session import Session
    from maplab_py.vimap import VIMap
    from maplab_py.vimap.ids import IdArray

_LOOPS = LoopClosureOptions()
_ANCHORING = AnchoringOptions()
_QUALITY = LandmarkQualityOptions()


def subjects(session: Session) -> list[tuple[str, str]]:
    """Return what can be asked about: the missions, then the recorded closures."""
    from maplab_py.algorithms.loop_closure.closure_record import described_ids
    from maplab_py.vimap.queries import mission_labels

    missions = [(label, "mission") for label in mission_labels(session.vi_map)]
    return missions + described_ids(session.vi_map)


@command(
    "why",
    example="why 59f0",
    see_also=("lc_report", "anchor_all_missions", "evaluate_landmark_quality"),
    completes={"subject": subjects, "other": "mission"},
)
def why(
    context: CommandContext,
    subject: str,
    other: str = "",
    *,
    loop_options: LoopClosureOptions = _LOOPS,
    anchoring: AnchoringOptions = _ANCHORING,
    quality: LandmarkQualityOptions = _QUALITY,
) -> ClosureExplanation | PairExplanation | MissionExplanation | LandmarkExplanation:
    """Explain a closure, a pair of missions, a mission or a landmark: every gate with its value.

    Each gate is shown with its threshold, whether it was passed, and the flag that moves it. Flags
    given here, or with `set`, show what would be decided with them.

    Args:
        subject: Beginning of the id of a closure or landmark, or a mission by name or id.
        other: Second mission: explain which gates the closures between the two missions fail.
    """
    from maplab_py.algorithms.landmarks.quality import explain_landmark
    from maplab_py.algorithms.loop_closure import explanation

    vi_map = context.vi_map
    if other:
        first, second = context.mission_row(subject), context.mission_row(other)
        if first == second:
            raise UserError("why: name two different missions")
        return explanation.explain_pair(
            vi_map, first, second, loop_options, anchoring.min_inlier_count, context.progress
        )
    kind, row = _resolve(vi_map, subject)
    if kind == "mission":
        return explanation.explain_mission(vi_map, row)
    if kind == "closure":
        return explanation.explain_closure(vi_map, row, loop_options)
    return explain_landmark(vi_map, row, quality)


def _resolve(vi_map: VIMap, subject: str) -> tuple[str, int]:
    """Return what a text names, and its row: a mission's name first, then the beginning of an id.

    Raises:
        UserError: It names nothing, or several things.
    """
    from maplab_py.algorithms.loop_closure.closure_record import read_record

    names = [str(name) for name in vi_map.missions.name]
    if subject in names and names.count(subject) == 1:
        return "mission", names.index(subject)
    prefix = subject.strip().lower()
    closures = read_record(vi_map).closures.id
    matches = _beginning(prefix, ("mission", vi_map.missions.id), ("closure", closures))
    matches = matches or _beginning(prefix, ("landmark", vi_map.landmarks.id))
    if not matches:
        matches = [
            ("mission", row, name)
            for row, name in enumerate(names)
            if prefix and name.lower().startswith(prefix)
        ]
    if len(matches) == 1:
        return matches[0][0], matches[0][1]
    if not matches:
        raise UserError(
            f"why: no closure, mission or landmark begins with '{subject}' "
            "(lc_report lists closures, map_stats missions)"
        )
    shown = ", ".join(f"{kind} {name[:12]}" for kind, _, name in matches[:4])
    raise UserError(
        f"why: '{subject}' is ambiguous: several ids begin with it ({shown}); give more digits"
    )


def _beginning(prefix: str, *ids: tuple[str, IdArray]) -> list[tuple[str, int, str]]:
    """Return kind, row and id of everything whose id begins with a prefix."""
    from maplab_py.vimap.ids import to_hex_list

    return [
        (kind, row, id_)
        for kind, words in ids
        for row, id_ in enumerate(to_hex_list(words))
        if prefix and id_.startswith(prefix)
    ]
