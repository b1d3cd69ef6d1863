"""Commands that keep a map up to date with new sessions."""

from datetime import UTC, datetime
from pathlib import Path

from maplab_plugins.evaluation import map_of_key_or_folder
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks.persistence import PersistenceOptions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.map_update.options import (
    ChronicleReport,
    GatheringReport,
    MapUpdateReport,
    UpdateOptions,
)
from maplab_py.plugin import CommandContext, Message, UserError, command
from maplab_py.report import counted
from maplab_py.vimap import VIMap


@command(
    "update_map",
    example="update_map --session=tuesday --max_landmarks=20000 --max_vertices=1000",
    see_also=("gather_evidence", "map_log", "compare_maps"),
    reads=("session",),
)
def update_map(
    context: CommandContext,
    session: str = "",
    *,
    options: UpdateOptions = UpdateOptions(),
    persistence: PersistenceOptions = PersistenceOptions(),
    loop_options: LoopClosureOptions = LoopClosureOptions(),
    keyframing: KeyframingOptions = KeyframingOptions(),
    assign_new_ids: bool = False,
) -> MapUpdateReport:
    """Update the map with a new session, and keep it within a budget.

    What the session should have seen and what it saw becomes evidence. Landmarks that hardly exist any more
    are removed; beyond the budget also the least useful ones, and vertices that others cover. Missions that
    lose vertices lose their inertial measurements: odometry edges join their poses.

    Args:
        session: Key of a map in memory, or folder of a map, with the missions of the session.
        assign_new_ids: Add a session whose ids are in the map already once more.
    """
    from maplab_py.algorithms.map_update.update import update_map as update

    if not session:
        raise UserError("the session is missing: give --session=FOLDER, a map of the new session")
    return context.apply(
        update,
        map_of_key_or_folder(context, session),
        options,
        persistence,
        loop_options,
        keyframing,
        assign_new_ids=assign_new_ids,
        map_folder=context.map_folder,
    )


@command(
    "gather_evidence",
    example="gather_evidence --date=2027-01-31",
    see_also=("update_map", "landmark_sparsify"),
    reads=("session",),
)
def gather_evidence(
    context: CommandContext,
    *,
    session: str = "",
    persistence: PersistenceOptions = PersistenceOptions(),
    date: str = "",
    forget: bool = False,
) -> GatheringReport:
    """Compare what each session of the map saw with what it should have seen, and judge the landmarks.

    Evidence of sessions that the map does not hold any more stays. landmark_sparsify chooses by the
    evidence instead of by observer counts.

    Args:
        session: Key of a map in memory, or folder of a map, whose missions give the evidence instead of
            those of the map: recorded by `rovioli` in it, or localised in it.
        date: Date of the probabilities that landmarks exist, as 2027-01-31; empty = the last session's.
        forget: Remove the evidence that the map has first.
    """
    from maplab_py.algorithms.landmarks.evidence import with_evidence
    from maplab_py.algorithms.map_update.update import gather_all

    at_s = _seconds(date) if date else None
    vi_map = with_evidence(context.vi_map, None) if forget else context.vi_map
    other = map_of_key_or_folder(context, session) if session else None
    result, report = gather_all(
        vi_map, persistence, session=other, at_s=at_s, progress=context.progress
    )
    context.commit(result)
    return report


def add_evidence(context: CommandContext, name: str, session: VIMap) -> None:
    """Add the evidence of a session to a map in memory (key), or to one in a folder.

    Raises:
        UserError: There is none, or none of its missions is anchored.
    """
    from maplab_py.algorithms.map_update.update import gather_all
    from maplab_py.storage.map_saving import save_map
    from maplab_py.storage.native import disk_copy, load_map

    progress, before = context.progress, disk_copy(Path(name))
    is_known = name in context.maps
    vi_map = (
        context.maps.get(name).vi_map if is_known else load_map(Path(name), progress=progress)[0]
    )
    vi_map, report = gather_all(vi_map, session=session, progress=progress)
    if is_known:
        context.commit(vi_map, name)
    elif not context.is_trial:
        save_map(vi_map, Path(name), known=before.fingerprint, progress=progress)
    tell_evidence(context, report, name)


def tell_evidence(context: CommandContext, report: GatheringReport, name: str) -> None:
    """Say what evidence has come into a map."""
    predicted = counted(sum(line.predicted for line in report.sessions), "landmark")
    matched = sum(line.matched for line in report.sessions)
    note = f"; {report.note}" if report.note else ""
    context.terminal.note(f"evidence in {name}: {predicted} expected, {matched} seen{note}")


@command("map_log", example="map_log", see_also=("update_map", "map_at"))
def map_log(context: CommandContext) -> ChronicleReport:
    """Show what each `update_map` added and removed, and the share of its session that is localised.

    It is counted in the map before the update, and in that after it without what the session saw itself.
    """
    from maplab_py.algorithms.map_update.chronicle import records

    known = records(context.vi_map, context.map_folder)
    stored_kb = round(sum(len(record.differences) for record in known) * 1e-3, 1)
    updates = tuple(fact for record in known for fact in record.facts)
    return ChronicleReport(updates, sum(bool(r.differences) for r in known), stored_kb)


@command("map_at", example="map_at --date=2020-01-31", see_also=("map_log", "undo"))
def map_at(context: CommandContext, date: str) -> Message:
    """Return to the map as it was at the end of a day, from the differences that updates stored.

    It is the map before the first update with a session of a later day. Twelve states are kept: of old
    updates some have become one. `undo` brings the present map back.

    Args:
        date: The day, as 2027-01-31.
    """
    import numpy as np

    from maplab_py.algorithms.map_update import chronicle
    from maplab_py.storage.resources.store import resource_path
    from maplab_py.vimap import without_resources

    end = f"{datetime.fromtimestamp(_seconds(date), UTC):%Y-%m-%d} 24"
    folder = context.map_folder
    known = chronicle.records(context.vi_map, folder)
    if not known:
        raise UserError("the map has no chronicle: update_map writes it")
    result, update = chronicle.map_at(context.vi_map, folder, end)
    if update is None:
        last = known[-1].facts[-1].date
        return Message(f"the map is as it was on {date}: its last update is of {last}")
    when = update.date
    paths = (resource_path(result, row, folder or Path()) for row in range(len(result.resources)))
    is_lost = np.array([not path.is_file() for path in paths], dtype=np.bool_)
    context.commit(without_resources(result, is_lost))
    lost = counted(int(is_lost.sum()), "resource")
    without = f", without {lost} whose files are not in its folder" if is_lost.any() else ""
    return Message(f"the map is as it was before the update of {when}{without}")


def _seconds(date: str) -> float:
    try:
        return datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp()
    except (ValueError, OverflowError):
        raise UserError(f"--date={date} is not a date: write it as 2027-01-31") from None
