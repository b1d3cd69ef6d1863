"""Commands on loop closures: detect, merge, relax, list, remove."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from maplab_plugins.map_update import tell_evidence
from maplab_py.algorithms.loop_closure.options import FeatureTypeOptions, LoopClosureOptions
from maplab_py.algorithms.map_update.options import EvidenceOptions
from maplab_py.algorithms.relaxation.options import RelaxationOptions, RelaxationReport
from maplab_py.plugin import CommandContext, Message, Report, UserError, command
from maplab_py.report import counted, view
from maplab_py.vimap import to_hex_list

if TYPE_CHECKING:
    from maplab_py.algorithms.loop_closure.reports import (
        ClosureRemovalReport,
        ClosureReport,
        ClosureVerdictReport,
        LoopClosureReport,
        TrainingReport,
    )
    from maplab_py.console.session.session import Session

_LOOPS = LoopClosureOptions()


class RelaxReport(Report):
    """Detected loop closures, the result of the relaxation, and merged landmarks."""

    loop_closures: LoopClosureReport
    relaxation: RelaxationReport
    merging: LoopClosureReport | None = None

    @property
    def failure(self) -> str:
        """Return why nothing was relaxed although there are loop closures, or could not be searched."""
        searched = self.loop_closures.failure
        if self.relaxation.num_ignored or self.loop_closures.accepted or searched:
            relaxed = self.relaxation.failure
            return f"{relaxed}; {searched}" if relaxed and searched else relaxed
        return ""

    @property
    def advice(self) -> str:
        """Tell that there was nothing to relax."""
        return "" if self.relaxation.num_loop_closures else "the map has no loop closures to relax"


class RelaxMissionsReport(Report):
    """One report per mission, by the beginning of its id."""

    missions: dict[str, RelaxReport]

    @property
    def failure(self) -> str:
        """Return why nothing was relaxed; empty if any mission was."""
        failures = [f"{k}: {each.failure}" for k, each in self.missions.items() if each.failure]
        if not failures or any(r.relaxation.num_loop_closures for r in self.missions.values()):
            return ""
        return "no mission was relaxed: " + "; ".join(failures)

    def display(self) -> Any:
        """Return one row per mission."""
        lines, notes = [], []
        for name, report in self.missions.items():
            relaxed = report.relaxation
            lines.append(
                view(
                    mission=name,
                    accepted_closures=report.loop_closures.accepted,
                    used=relaxed.num_loop_closures,
                    switched_off=relaxed.num_switched_off,
                    cost_before=relaxed.cost_before,
                    cost_after=relaxed.cost_after,
                    mean_correction_m=relaxed.mean_correction_m,
                    max_correction_m=relaxed.max_correction_m,
                    landmarks_merged=report.merging.landmarks_merged if report.merging else None,
                )
            )
            texts = (report.loop_closures.reason, *relaxed.notes)
            notes += [f"{name}: {text}" for text in texts if text]
        return view({"missions": ""}, missions=lines, notes=notes)


@command(
    "loopclosure_all_missions",
    "lc",
    example="lc --lc_min_inlier_count=15",
    see_also=("relax", "lc_report", "optimize_visual_inertial", "delete_loopclosure_edges"),
)
def loopclosure_all_missions(
    context: CommandContext,
    *,
    options: LoopClosureOptions = _LOOPS,
    evidence: EvidenceOptions = EvidenceOptions(),
    lc_insert_lc_edge_instead_of_merging: bool = False,
    map_mission_list: str = "",
) -> LoopClosureReport:
    """Detect loop closures within and between missions and merge their landmarks.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.

    Args:
        lc_insert_lc_edge_instead_of_merging: Add loop closure edges instead of merging landmarks.
        map_mission_list: Missions to close loops in and between, separated by commas; empty = all.
    """
    from maplab_py.algorithms.map_update.update import gather_all

    missions = context.mission_rows("", map_mission_list)
    report = _close(context, options, missions, as_edges=lc_insert_lc_edge_instead_of_merging)
    if evidence.gather_evidence:
        gathered = context.apply(gather_all, missions=missions, has_new_loops=True)
        tell_evidence(context, gathered, context.map_key)
    return report


@command("loopclosure_one_mission", "lcom", example="lcom --map_mission=59f0")
def loopclosure_one_mission(
    context: CommandContext,
    *,
    options: LoopClosureOptions = _LOOPS,
    lc_insert_lc_edge_instead_of_merging: bool = False,
    map_mission: str = "",
) -> LoopClosureReport:
    """Detect loop closures within one mission and merge their landmarks.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.

    Args:
        lc_insert_lc_edge_instead_of_merging: Add loop closure edges instead of merging landmarks.
    """
    missions = np.array([context.mission_row(map_mission)])
    return _close(context, options, missions, as_edges=lc_insert_lc_edge_instead_of_merging)


@command("delete_loopclosure_edges", "dlc", example="dlc")
def delete_loopclosure_edges(context: CommandContext) -> Message:
    """Remove all loop closure edges."""
    from maplab_py.vimap.edits import remove_loop_closure_edges

    count = len(context.vi_map.loop_closure_edges)
    context.commit(remove_loop_closure_edges(context.vi_map, np.ones(count, dtype=np.bool_)))
    return Message(f"removed {counted(count, 'loop closure edge')}")


@command(
    "train_projection_matrix",
    example="train_projection_matrix projection.npz",
    see_also=("loopclosure_all_missions",),
    writes_files=True,
)
def train_projection_matrix(
    context: CommandContext,
    file: Path,
    *,
    features: FeatureTypeOptions = FeatureTypeOptions(),
    lc_target_dimensionality: int = _LOOPS.target_dimensionality,
    map_mission_list: str = "",
    overwrite: bool = False,
) -> TrainingReport:
    """Train the projection of descriptors on the feature tracks of the map and write it.

    Descriptors of one feature type are used.

    Args:
        file: File to write; to be given as --lc_projection_matrix_filename.
        lc_target_dimensionality: Dimensions of the projected descriptors.
        map_mission_list: Missions to learn from, separated by commas; empty = all.
    """
    from maplab_py.algorithms.loop_closure.features import train_projection
    from maplab_py.vision.projection import save_projection

    missions = context.mission_rows("", map_mission_list)
    projection, report = train_projection(
        context.vi_map,
        missions,
        lc_target_dimensionality,
        feature_type=features.type_number,
        sizes=features.sizes,
    )
    save_projection(projection, file, overwrite=overwrite)
    return dataclasses.replace(report, file=str(file))


@command(
    "lc_report",
    example="lc_report --sort_by=gap --limit=10",
    see_also=("why", "remove_loopclosure", "loopclosure_all_missions"),
)
def lc_report(
    context: CommandContext,
    *,
    which: Literal["accepted", "refused", "all"] = "accepted",
    sort_by: Literal["time", "gap", "correction", "inliers", "near_miss"] = "time",
    reason: str = "",
    descending: bool = False,
    limit: int = 50,
    file: Path | None = None,
    map_mission_list: str = "",
    overwrite: bool = False,
) -> ClosureReport:
    """List the recorded loop closures with their verdicts and the reasons for refusals.

    Args:
        which: Which closures to list.
        sort_by: time of the query; gap = distance of the map's present poses from the closure,
            largest first; correction = change of the query's position at detection time,
            largest first; inliers, fewest first; near_miss: refused closures that fail the fewest
            gates by least first (see: why).
        reason: Only refused closures whose verdict contains this text, such as "another place".
        descending: Reverse the order.
        limit: Largest number of closures to list; 0 = all.
        file: Write all chosen closures to this file, JSON or CSV by its ending.
        map_mission_list: Only closures with an end in these missions, separated by commas.
    """
    from maplab_py.algorithms.loop_closure.listing import list_closures, write_closures

    missions = context.mission_rows("", map_mission_list)
    report = list_closures(
        context.vi_map,
        which="refused" if reason or sort_by == "near_miss" else which,
        missions=missions,
        sort_by=sort_by,
        reason=reason,
        descending=descending,
    )
    if file is not None:
        write_closures(report, file, overwrite=overwrite)
    lines = report.closures if limit <= 0 else report.closures[:limit]
    return dataclasses.replace(
        report, closures=lines, shown=len(lines), file="" if file is None else str(file)
    )


def closure_values(session: Session) -> list[tuple[str, str]]:
    """Return the ids of the recorded closures with what was decided on them."""
    from maplab_py.algorithms.loop_closure.closure_record import described_ids

    return described_ids(session.vi_map)


@command(
    "remove_loopclosure",
    "rlc",
    example="remove_loopclosure 59f0a1b2 --neighbors_s=2",
    see_also=("lc_report", "delete_loopclosure_edges"),
    completes={"closures": closure_values},
)
def remove_loopclosure(
    context: CommandContext, closures: str, *, neighbors_s: float = 0.0
) -> ClosureRemovalReport:
    """Remove loop closures: their edges, and merges that too few others support.

    Later searches refuse them, until the record is deleted.

    Args:
        closures: Beginnings of the closures' ids as lc_report shows them, separated by commas.
        neighbors_s: Also remove accepted closures both of whose ends are within this time.
    """
    from maplab_py.algorithms.loop_closure import listing, record_updates

    ids = listing.find_closures(context.vi_map, closures.split(","), neighbours_s=neighbors_s)
    return context.apply(record_updates.remove_closures, ids)


@command(
    "judge_closures",
    example="judge_closures --refuse=59f0a1b2",
    see_also=("why", "lc_report", "relax", "visualize"),
    completes={"accept": closure_values, "refuse": closure_values},
)
def judge_closures(
    context: CommandContext,
    *,
    accept: str = "",
    refuse: str = "",
    options: LoopClosureOptions = _LOOPS,
) -> ClosureVerdictReport:
    """Accept or refuse recorded closures by hand; without ids as in the viewer's closure court.

    An accepted closure becomes an edge with the pose that was found, for relax. A refused one is
    removed as by remove_loopclosure; later searches refuse it, too.

    Args:
        accept: Beginnings of ids as lc_report shows them, separated by commas.
        refuse: The same.
    """
    from maplab_plugins.visualization.following import verdicts_of_page
    from maplab_py.algorithms.loop_closure.listing import find_closures
    from maplab_py.algorithms.loop_closure.record_updates import accept_closures, remove_closures
    from maplab_py.algorithms.loop_closure.reports import ClosureVerdictReport

    lists = [[name for name in text.split(",") if name.strip()] for text in (accept, refuse)]
    if not any(lists):
        lists = verdicts_of_page(context)
    accepted, refused = (find_closures(context.vi_map, names) for names in lists)
    if set(map(bytes, accepted)) & set(map(bytes, refused)):
        raise UserError("judge_closures: a closure is both accepted and refused")
    without, removal = remove_closures(context.vi_map, refused)
    result = accept_closures(without, accepted, options)
    context.commit(result)
    return ClosureVerdictReport(
        accepted=tuple(name[:8] for name in to_hex_list(accepted)),
        refused=removal.closures,
        edges_added=len(result.loop_closure_edges) - len(without.loop_closure_edges),
        edges_removed=removal.edges_removed,
        landmarks_restored=removal.landmarks_restored,
        observations_moved=removal.observations_moved,
        notes=removal.notes,
    )


@command("delete_loopclosure_record")
def delete_loopclosure_record(context: CommandContext) -> Message:
    """Delete the record of loop closures; landmarks, edges and poses stay as they are."""
    from maplab_py.algorithms.loop_closure.closure_record import drop_record

    context.commit(drop_record(context.vi_map))
    return Message("deleted the record of loop closures")


@command(
    "relax",
    example="relax --relax_robustness=switchable",
    see_also=("loopclosure_all_missions", "relax_missions_independently"),
)
def relax(
    context: CommandContext,
    *,
    loop_options: LoopClosureOptions = _LOOPS,
    options: RelaxationOptions = RelaxationOptions(),
    lc_relax_merge_landmarks: bool = False,
    map_mission_list: str = "",
) -> RelaxReport:
    """Find loop closures and relax the pose graph over them and over the map's loop closure edges.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.

    Args:
        lc_relax_merge_landmarks: Merge the landmarks of the closures afterwards, as lc does.
        map_mission_list: Missions that may move, separated by commas; empty = all.
    """
    missions = context.mission_rows("", map_mission_list)
    return _relax(context, loop_options, options, missions, merge=lc_relax_merge_landmarks)


@command("relax_missions_independently", "srelax", example="srelax")
def relax_missions_independently(
    context: CommandContext,
    *,
    loop_options: LoopClosureOptions = _LOOPS,
    options: RelaxationOptions = RelaxationOptions(),
    lc_relax_merge_landmarks: bool = False,
    map_mission_list: str = "",
) -> RelaxMissionsReport:
    """Relax every mission over its internal loop closures only.

    Places are recognised by descriptors of one feature type; keypoints with others are left out.

    Args:
        lc_relax_merge_landmarks: Merge the landmarks of the closures afterwards, as lc does.
        map_mission_list: Missions to relax, separated by commas; empty = all.
    """
    from maplab_py.vimap.ids import to_hex

    rows = context.mission_rows("", map_mission_list)
    rows = np.arange(len(context.vi_map.missions)) if rows is None else rows
    reports = {}
    for row in rows:
        name = to_hex(context.vi_map.missions.id[row])[:8]
        reports[name] = _relax(
            context, loop_options, options, np.array([row]), merge=lc_relax_merge_landmarks
        )
    return RelaxMissionsReport(reports)


def _close(
    context: CommandContext,
    options: LoopClosureOptions,
    missions: NDArray[np.int64] | None,
    *,
    as_edges: bool,
) -> LoopClosureReport:
    from maplab_py.algorithms.loop_closure.workflow import close_loops, insert_edges

    run = insert_edges if as_edges else close_loops
    return context.apply(run, options, missions=missions)


def _relax(
    context: CommandContext,
    loop_options: LoopClosureOptions,
    options: RelaxationOptions,
    missions: NDArray[np.int64] | None,
    *,
    merge: bool,
) -> RelaxReport:
    from maplab_py.algorithms.loop_closure.workflow import close_loops
    from maplab_py.algorithms.relaxation.relaxation import relax_over_loops

    result, search_report, relaxed = relax_over_loops(
        context.vi_map, options, loop_options, missions=missions, progress=context.progress
    )
    merging = None
    if merge and not relaxed.failure:
        result, merging = close_loops(
            result, loop_options, missions=missions, progress=context.progress
        )
    context.commit(result)
    return RelaxReport(search_report, relaxed, merging)
