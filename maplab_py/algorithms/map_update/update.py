"""Update a map with a session: anchor, merge, optimise, gather evidence, keep the budget."""

import dataclasses
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.algorithms.landmarks import tracks, triangulation
from maplab_py.algorithms.landmarks.evidence import (
    add_session,
    birth_times_s,
    read_evidence,
    session_times_s,
    with_evidence,
)
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.persistence import (
    PersistenceOptions,
    existence,
    learn_detection,
    summarise_oldest,
)
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.algorithms.localization.database import database_of_map
from maplab_py.algorithms.localization.localization import localize_missions
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.loop_closure import features, workflow
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.map_update import changes, chronicle, placing, thinning, visibility
from maplab_py.algorithms.map_update.options import (
    ChangeReport,
    EvidenceReport,
    GatheringReport,
    MapUpdateReport,
    UpdateOptions,
)
from maplab_py.algorithms.vi_optimization import local, optimization
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.array_types import I64, NDArray, mask_of
from maplab_py.errors import EstimationError, UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.vimap import IdArray, VIMap, edits, merge, to_hex, to_hex_list

_FIRST_ITERATIONS, _LOCAL_ITERATIONS = 10, 8
_FREE, _FIXED = 150, 150
"""Vertices beside the new ones that are optimised with them, and held fixed around them."""
_MIN_OBSERVERS = 2
"""After keyframing, which removes most observations."""
_LIKELY = 0.5
_BUDGET, _PERSISTENCE = UpdateOptions(), PersistenceOptions()
_LOOPS, _KEYFRAMING = LoopClosureOptions(), KeyframingOptions()


def prepare_session(
    session: VIMap,
    keyframing: KeyframingOptions = _KEYFRAMING,
    *,
    progress: Progress = SILENT,
) -> VIMap:
    """Return a session with landmarks, keyframed and optimised by itself.

    Raises:
        EstimationError: Nothing can be optimised.
    """
    steps = (
        lambda m: tracks.init_tracks(m, LandmarkQualityOptions()),
        lambda m: triangulation.retriangulate(m, LandmarkQualityOptions()),
        lambda m: keyframe(m, keyframing),
        lambda m: evaluate_quality(m, LandmarkQualityOptions(min_observers=_MIN_OBSERVERS)),
        lambda m: optimization.optimize(
            m, VIOptimizationOptions(num_iterations=_FIRST_ITERATIONS), progress=progress
        ),
    )
    for step in steps:
        progress.check()
        session, _ = step(session)
    return session


def update_map(
    vi_map: VIMap,
    session: VIMap,
    options: UpdateOptions = _BUDGET,
    persistence: PersistenceOptions = _PERSISTENCE,
    loops: LoopClosureOptions = _LOOPS,
    keyframing: KeyframingOptions = _KEYFRAMING,
    *,
    assign_new_ids: bool = False,
    map_folder: Path | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, MapUpdateReport]:
    """Update a map with the missions of a session.

    Args:
        vi_map: The map; a mission of it is anchored.
        session: One or several missions that are not in the map.
        loops: How places are recognised.
        keyframing: Of the session.
        assign_new_ids: Whether the session may be in the map already; it is added once more.
        map_folder: Folder of the map, which has its chronicle.

    Raises:
        UserError: No mission of the map is anchored, or the budget cannot be met.
        MapError: The session does not fit the map, or is in it already.
        EstimationError: The session cannot be anchored in the map, or not be optimised.
    """
    _check_anchored(vi_map)
    if assign_new_ids:
        session = edits.with_new_ids(session, edits.content_rng(vi_map, "update", session))
    merge.check_disjoint(vi_map, session)
    prepared = prepare_session(session, keyframing, progress=progress)
    whole, merged, localized = merge_session(vi_map, prepared, loops, progress=progress)
    every = np.ones(len(whole.missions), dtype=np.bool_)
    whole = edits.with_texts_on_newest(whole, every)
    lines = []
    new_ids = prepared.missions.id
    for mission in whole.mission_index.rows(new_ids).tolist():
        whole, line = gather(whole, mission, persistence, progress=progress)
        lines.append(line)
    is_new = mask_of(len(whole.missions), whole.mission_index.rows(new_ids))
    result, thinned = thinning.thin(whole, is_new, options, persistence, progress)
    result = chronicle.stored_order(result)
    report = MapUpdateReport(
        sessions=tuple(lines),
        vertices_before=len(vi_map.vertices),
        vertices_added=len(prepared.vertices),
        vertices_removed=thinned.vertices,
        vertices_after=len(result.vertices),
        landmarks_before=len(vi_map.landmarks),
        landmarks_added=len(prepared.landmarks),
        landmarks_merged=merged,
        landmarks_vanished=thinned.landmarks_vanished,
        landmarks_thinned=thinned.landmarks_thinned,
        landmarks_after=len(result.landmarks),
        missions_removed=thinned.missions,
        missions_without_imu=thinned.missions_without_imu,
        megabytes_before=thinning.size_mb(vi_map),
        megabytes_after=thinning.size_mb(result),
        localized_before=localized,
        localized_after=_localized(result, prepared, progress),
        notes=tuple(
            f"session {line.session} tells nothing: it should have seen no landmark of an earlier one"
            for line in lines
            if line.predicted == 0
        ),
    )
    return chronicle.with_record(vi_map, result, report, map_folder), report


def _localized(vi_map: VIMap, session: VIMap, progress: Progress) -> float:
    """Return the share of a session's vertices that are localised in the other missions of a map."""
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    known[vi_map.mission_index.rows(session.missions.id)] = False
    if not known.any():
        return 0.0
    database = database_of_map(
        vi_map, missions=np.flatnonzero(known), feature_type=visibility.main_feature_type(vi_map)
    )
    localized = localize_missions(database, session, LocalizationOptions(), progress=progress)
    return float(localized.is_localized.mean())


def merge_session(
    vi_map: VIMap,
    session: VIMap,
    loops: LoopClosureOptions = _LOOPS,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, int, float]:
    """Return the map with a prepared session anchored, merged and optimised.

    Raises:
        MapError: The session does not fit the map, or is in it already.
        EstimationError: The session cannot be anchored in the map, or not be optimised.

    Returns:
        The map, the landmarks merged, and the share of the session's vertices that were localised.
    """
    placed = placing.place(vi_map, session, progress)
    whole, _ = merge.merge_maps(vi_map, _at_place(session, placed))
    ids = session.missions.id
    if len(placed.missions) < len(session.missions):
        whole = _anchored(whole, ids, loops, progress)
    landmark = whole.landmark_index.rows(vi_map.landmarks.id[placed.landmark])
    # the keypoints of the session follow those of the map
    keypoint = placed.keypoint + len(vi_map.keypoints)
    whole, merged = placing.with_matches(whole, keypoint[landmark >= 0], landmark[landmark >= 0])
    whole = _optimized(whole, ids, progress)
    for mission in whole.mission_index.rows(ids).tolist():
        seen = visibility.predict(whole, mission, progress)
        matched = seen.keypoint >= 0
        whole, count = placing.with_matches(whole, seen.keypoint[matched], seen.landmark[matched])
        merged += count
    whole = _optimized(whole, ids, progress)
    quality = LandmarkQualityOptions(min_observers=_MIN_OBSERVERS)
    rows = whole.mission_index.rows(ids)
    whole, _ = evaluate_quality(whole, quality, missions=rows, progress=progress)
    return whole, merged, placed.localized


def changes_since(
    vi_map: VIMap, session: VIMap, *, progress: Progress = SILENT
) -> tuple[VIMap, ChangeReport]:
    """Return the map with a session, and the regions in which it differs; neither is changed.

    Raises:
        UserError: No mission of the map is anchored, or the session is in the map.
        MapError: The session does not fit the map.
        EstimationError: The session cannot be anchored in the map, or not be optimised.
    """
    _check_anchored(vi_map)
    shared = np.count_nonzero(vi_map.vertex_index.rows(session.vertices.id) >= 0)
    if shared > 2 * len(session.missions):  # parts of a recording share the vertices at their ends
        raise UserError(
            "the other map is in the selected one: --changes needs one of another session"
        )
    renamed = session
    if shared:
        renamed = edits.with_new_ids(session, edits.content_rng(vi_map, "changes", session))
    prepared = prepare_session(renamed, progress=progress)
    whole, *_ = merge_session(vi_map, prepared, progress=progress)
    later = mask_of(len(whole.missions), whole.mission_index.rows(prepared.missions.id))
    report = changes.find_changes(whole, later, progress)
    if shared:
        names = to_hex_list(renamed.vertices.id), to_hex_list(session.vertices.id)
        report = _with_names(report, dict(zip(*names, strict=True)))
    return whole, report


def at_places_of(whole: VIMap, session: VIMap) -> VIMap:
    """Return a session with the base frames that its missions, the last of a map, have there."""
    T_G_M = whole.T_G_M[-len(session.missions) :]
    frames = session.baseframes.put(session.missions.baseframe, T_G_M=T_G_M)
    return session.replace(baseframes=frames)


def _with_names(report: ChangeReport, name: dict[str, str]) -> ChangeReport:
    """Return the report with other names (ids) of vertices, as far as they have any."""
    renamed = (
        dataclasses.replace(
            change,
            view_before=name.get(change.view_before, change.view_before),
            view_after=name.get(change.view_after, change.view_after),
        )
        for change in report.changes
    )
    return dataclasses.replace(report, changes=tuple(renamed))


def _check_anchored(vi_map: VIMap) -> None:
    if not vi_map.baseframes.is_known[vi_map.missions.baseframe].any():
        raise UserError(
            "no mission of the map is anchored: run set_mission_baseframe_to_known first",
            remedy="set_mission_baseframe_to_known",
        )


def _at_place(session: VIMap, placed: placing.Placed) -> VIMap:
    """Return a session with the base frames of placed missions known, all others unknown."""
    rows = session.missions.baseframe[placed.missions]
    frames = session.baseframes.put(slice(None), is_known=False)
    return session.replace(baseframes=frames.put(rows, T_G_M=placed.T_G_M, is_known=True))


def _anchored(
    whole: VIMap, missions: IdArray, loops: LoopClosureOptions, progress: Progress
) -> VIMap:
    """Return the map with missions (ids) anchored and merged by closures of loops."""
    whole, report = anchor_missions(whole, loop_options=loops, progress=progress)
    rows = whole.mission_index.rows(missions)
    unknown = rows[~whole.baseframes.is_known[whole.missions.baseframe[rows]]]
    if len(unknown):
        raise EstimationError(
            f"mission {to_hex(whole.missions.id[unknown[0]])[:8]} of the session cannot be anchored "
            f"in the map: {report.failure or 'too few places are recognised'}"
        )
    scope = features.SearchScope(np.isin(whole.vertices.mission, rows), features.ProjectionMemory())
    return workflow.close_loops(whole, loops, scope=scope, progress=progress)[0]


def _optimized(whole: VIMap, missions: IdArray, progress: Progress) -> VIMap:
    rows: I64 = np.flatnonzero(np.isin(whole.vertices.mission, whole.mission_index.rows(missions)))
    options = VIOptimizationOptions(
        num_iterations=_LOCAL_ITERATIONS,
        hide_iterations_console_output=True,
        include_6dof_odometry=True,
    )
    return local.optimize_around(
        whole, rows, options, max_free=_FREE, max_fixed=_FIXED, progress=progress
    )[0]


def gather(
    vi_map: VIMap,
    mission: int,
    persistence: PersistenceOptions = _PERSISTENCE,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, EvidenceReport]:
    """Add the evidence of a mission (row) for the landmarks of earlier ones to the map.

    Evidence of the mission that the map has already is not counted twice.

    Raises:
        EstimationError: The map has no descriptors.
        MapError: The evidence in the map is damaged.
    """
    before, born = read_evidence(vi_map), birth_times_s(vi_map)
    before["born_s"] = np.where(before["born_s"] > 0, before["born_s"], born)
    session, false_match = visibility.outcome(
        vi_map, mission, visibility.predict(vi_map, mission, progress)
    )
    session = session.take(before["born_s"][session.landmark] < session.time_s)
    detection = learn_detection(before, persistence)
    _, full = add_session(before, session)
    evidence, _ = add_session(summarise_oldest(before, full, persistence, detection), session)
    vanished = existence(evidence, persistence, detection=detection) < _LIKELY
    report = EvidenceReport(
        session=to_hex(vi_map.missions.id[mission])[:8],
        date=_date(session.time_s),
        predicted=len(session.landmark),
        matched=int(np.count_nonzero(session.matched)),
        false_match=false_match,
        detection=detection.mean,
        probably_vanished=int(vanished.sum()),
    )
    return with_evidence(vi_map, evidence), report


def gather_all(
    vi_map: VIMap,
    persistence: PersistenceOptions = _PERSISTENCE,
    *,
    session: VIMap | None = None,
    missions: I64 | None = None,
    has_new_loops: bool = False,
    at_s: float | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, GatheringReport]:
    """Add the evidence of all anchored missions, in the order of time, and judge the landmarks.

    Args:
        session: Another map, whose missions give the evidence instead; it does not come into the map.
        missions: Those (rows) that give the evidence; None = all.
        has_new_loops: The poses do not fit the landmarks yet: a copy of the map is optimised for it.
        at_s: Time of the probabilities [s since 1970]; None = that of the last mission.

    Raises:
        EstimationError: The map has no descriptors.
        MapError: The evidence in the map is damaged.
    """
    whole, chosen = vi_map, vi_map.missions.id[slice(None) if missions is None else missions]
    if has_new_loops:
        options = VIOptimizationOptions(num_iterations=_FIRST_ITERATIONS)
        whole, _ = optimization.optimize(vi_map, options, progress=progress)
    if session is not None:
        _check_anchored(vi_map)
        session = edits.with_new_ids(session, edits.content_rng(vi_map, "evidence", session))
        prepared = prepare_session(session, progress=progress)
        whole, *_ = merge_session(vi_map, prepared, progress=progress)
        chosen = prepared.missions.id
    times = session_times_s(whole)
    known = whole.baseframes.is_known[whole.missions.baseframe]
    known &= np.isin(np.arange(len(known)), whole.mission_index.rows(chosen))
    lines = []
    for mission in np.argsort(times, kind="stable"):
        if known[mission]:
            whole, line = gather(whole, int(mission), persistence, progress=progress)
            lines.append(line)
    evidence = _of_landmarks(whole, vi_map)
    vi_map = with_evidence(vi_map, evidence)
    at_s = float(times.max(initial=1)) if at_s is None else at_s
    detection = learn_detection(evidence, persistence)
    used = evidence["recent"]["time_s"][:, -1] > 0
    exists = existence(evidence[used], persistence, at_s=at_s, detection=detection)
    counts = np.histogram(exists, [0.0, 0.1, 0.5, 0.9, 1.0 + 1e-9])[0]
    unknown = len(chosen) - len(lines)
    note = f"without evidence, as not anchored: {counted(unknown, 'mission')}" if unknown else ""
    report = GatheringReport(
        sessions=tuple(lines),
        landmarks=len(evidence),
        with_evidence=int(used.sum()),
        detection=detection.mean,
        date=_date(at_s),
        certain=int(counts[3]),
        likely=int(counts[2]),
        unlikely=int(counts[1]),
        vanished=int(counts[0]),
        note=note,
    )
    return vi_map, report


def _of_landmarks(whole: VIMap, vi_map: VIMap) -> NDArray[Any]:
    """Return the evidence of a map's landmarks (L,) in a larger map; merged ones keep theirs."""
    evidence = read_evidence(vi_map)
    row = whole.landmark_index.rows(vi_map.landmarks.id)
    evidence[row >= 0] = read_evidence(whole)[row[row >= 0]]
    return evidence


def _date(time_s: float) -> str:
    return f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M}"
