"""Updates of a map with simulated sessions."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.evidence import (
    has_evidence,
    read_evidence,
    session_times_s,
    with_evidence,
)
from maplab_py.algorithms.landmarks.persistence import PersistenceOptions, existence
from maplab_py.algorithms.map_update.changes import find_changes
from maplab_py.algorithms.map_update.options import UpdateOptions
from maplab_py.algorithms.map_update.placing import with_matches
from maplab_py.algorithms.map_update.thinning import thin
from maplab_py.algorithms.map_update.update import (
    changes_since,
    gather_all,
    prepare_session,
    update_map,
)
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.console.session.session import Session
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.simulation.scenario import ChangeOptions, SessionOptions
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.summary_map import read_summary_map, write_summary_map
from maplab_py.vimap import FeatureType, VIMap, from_hex
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.descriptors import DescriptorBlock, DescriptorDepth
from maplab_py.vimap.table import object_column
from maplab_py.vimap.tables import Backbone
from tests.simulation.small import SMALL

SCAN = SessionOptions(duration_s=8.0, turns=0.5)
YEAR = dataclasses.replace(
    SMALL,
    changes=ChangeOptions(days_between_sessions=30.0, moved_share=0.5, replaced_posters=1),
    sessions=(SCAN, SCAN, dataclasses.replace(SCAN, height_m=1.6)),
)


@cache
def sessions() -> SimulatedData:
    return simulate(YEAR)


@cache
def first() -> VIMap:
    prepared = prepare_session(sessions().maps[0])
    known = prepared.baseframes.replace(is_known=np.ones(1, dtype=np.bool_))
    return prepared.replace(baseframes=known)


@cache
def updated() -> tuple[VIMap, object]:
    return update_map(first(), sessions().maps[1])


def test_an_update_without_a_budget_keeps_everything_and_gathers_evidence() -> None:
    vi_map, report = updated()
    assert check_consistency(vi_map).errors == ()
    assert report.landmarks_vanished == report.landmarks_thinned == report.vertices_removed == 0
    assert report.vertices_after == report.vertices_before + report.vertices_added
    assert (vi_map.landmark_index.rows(first().landmarks.id) >= 0).mean() > 0.8
    line = report.sessions[0]
    assert line.predicted > 50
    assert line.matched > 0.4 * line.predicted
    assert line.false_match < 0.05
    evidence = read_evidence(vi_map)
    assert np.count_nonzero(evidence["recent"]["time_s"][:, -1]) == line.predicted


def test_a_budget_is_kept_and_old_missions_are_joined_by_odometry() -> None:
    vi_map, _ = updated()
    options = UpdateOptions(max_landmarks=300, max_vertices=len(vi_map.vertices) - 4)
    result, report = update_map(vi_map, sessions().maps[2], options)
    assert check_consistency(result).errors == ()
    assert len(result.landmarks) <= 300
    assert len(result.vertices) == options.max_vertices == report.vertices_after
    assert has_evidence(result)
    thinned = result.missions.backbone == Backbone.ODOMETRY
    assert np.count_nonzero(thinned) == report.missions_without_imu > 0
    assert not thinned[-1]
    assert not thinned[result.vertices.mission[result.imu_edges.from_vertex]].any()
    assert len(result.transformation_edges) > 0


def test_a_size_is_kept() -> None:
    session = Session()
    session.maps.add("session", sessions().maps[2])
    session.maps.add("map", updated()[0])
    before = session.vi_map
    flags = {"session": "session", "max_map_mb": 0.4}
    planned = session.run("update_map", dry_run=True, **flags)
    assert session.vi_map is before
    done = session.run("update_map", **flags)
    assert done.megabytes_after == planned.megabytes_after <= 0.4 < done.megabytes_before
    session.run("undo")
    assert session.vi_map is before
    judged = session.run("gather_evidence", date="2021-01-01")
    assert judged.with_evidence == sum(
        (judged.certain, judged.likely, judged.unlikely, judged.vanished)
    )
    assert len(judged.sessions) == 2


def test_a_size_that_cannot_be_met_is_refused() -> None:
    vi_map, _ = updated()
    is_new = np.array([False, True])
    options = UpdateOptions(max_map_mb=1e-4)
    with pytest.raises(UserError, match=r"--max_map_mb=0\.0001 cannot be met: the map has"):
        thin(vi_map, is_new, options, PersistenceOptions())


def test_a_landmark_that_a_session_merges_keeps_its_evidence() -> None:
    vi_map, _ = updated()
    evidence = read_evidence(vi_map)
    observers = np.diff(vi_map.observation_start)
    hits = (evidence["recent"]["matched"] > 0).any(axis=1)
    source = int(np.flatnonzero(hits & (observers >= 2))[0])
    target = int(np.flatnonzero(~hits)[0])
    keypoints = np.flatnonzero(vi_map.keypoints.landmark == source)
    merged, count = with_matches(vi_map, keypoints, np.full(len(keypoints), target))
    assert count == 1
    row = int(merged.landmark_index.rows(vi_map.landmarks.id[[target]])[0])
    assert (read_evidence(merged)["recent"][row]["matched"] > 0).any()


def test_mistakes_are_one_line() -> None:
    vi_map, _ = updated()
    with pytest.raises(MapError, match="is in both maps"):
        update_map(vi_map, sessions().maps[1])
    with pytest.raises(UserError, match="set_mission_baseframe_to_known"):
        update_map(sessions().maps[0], sessions().maps[1])
    with pytest.raises(UserError, match="set_mission_baseframe_to_known"):
        changes_since(sessions().maps[0], sessions().maps[1])
    with pytest.raises(UserError, match="is in the selected one"):
        changes_since(vi_map, sessions().maps[1])
    session = Session()
    session.maps.add("map", vi_map)
    with pytest.raises(UserError, match="--session=FOLDER"):
        session.run("update_map")
    with pytest.raises(UserError, match="neither a map in memory"):
        session.run("update_map", session="nowhere")
    with pytest.raises(UserError, match="2027-01-31"):
        session.run("gather_evidence", date="tomorrow")


@pytest.mark.slow
def test_furniture_that_moves_is_a_change_and_an_unchanged_room_has_none() -> None:
    scenario = dataclasses.replace(
        YEAR,
        world=dataclasses.replace(YEAR.world, furniture_per_room=6, landmarks_per_room=2500),
        measurement=dataclasses.replace(YEAR.measurement, max_keypoints=400),
        appearance=dataclasses.replace(YEAR.appearance, vanish_share=0.0),
        changes=ChangeOptions(refurbished_session=2, refurbished_share=1.0, refurbished_posters=0),
        sessions=tuple(
            dataclasses.replace(SCAN, duration_s=14.0, turns=1.0, height_m=h)
            for h in (1.5, 1.4, 1.5)
        ),
    )
    maps = simulate(scenario).maps
    before = prepare_session(maps[0])
    known = before.baseframes.replace(is_known=np.ones(1, dtype=np.bool_))
    before = before.replace(baseframes=known)
    assert changes_since(before, maps[1])[1].changes == ()
    two, _ = update_map(before, maps[1])
    whole, report = changes_since(two, maps[2])
    for change in report.changes:
        views = [from_hex(view) for view in (change.view_before, change.view_after)]
        rows = whole.vertex_index.rows(np.array(views))
        early, late = whole.vertices.mission[rows]
        assert early < 2 == late
        assert change.after <= change.until
    assert {change.change for change in report.changes} == {"vanished", "appeared"}
    assert max(change.size_m for change in report.changes) > 0.5
    shared = maps[2].vertices.id.copy()
    shared[0] = two.vertices.id[-1]  # parts of a recording share a vertex
    part = maps[2].replace(vertices=maps[2].vertices.replace(id=shared))
    for change in changes_since(two, part)[1].changes:
        assert part.vertex_index.rows(np.array([from_hex(change.view_after)]))[0] >= 0
    with pytest.raises(UserError, match="earlier and later"):
        find_changes(two, np.zeros(2, dtype=np.bool_))


def test_a_session_gives_evidence_without_coming_into_the_map() -> None:
    vi_map, session = updated()[0], sessions().maps[2]
    result, report = gather_all(vi_map, session=session)
    assert result.missions.id.tolist() == vi_map.missions.id.tolist()
    assert [line.date for line in report.sessions] == ["2020-11-12 12:26"]
    assert report.sessions[0].predicted > 50
    recent = read_evidence(result)["recent"]
    newest = int(recent["time_s"].max())
    assert np.count_nonzero((recent["time_s"] == newest).any(axis=1)) > 50
    assert newest > read_evidence(vi_map)["recent"]["time_s"].max()
    again, _ = gather_all(result, session=session)
    for name in ("hits", "misses"):
        np.testing.assert_array_equal(read_evidence(again)[name], read_evidence(result)[name])
    times = read_evidence(again)["recent"]["time_s"]
    assert not ((times[:, 1:] == times[:, :-1]) & (times[:, 1:] > 0)).any()


def test_sessions_that_are_localised_or_closed_in_count_once(tmp_path: Path) -> None:
    session = Session()
    session.maps.add("map", updated()[0])
    session.run("save", map_folder=tmp_path / "map")
    session.maps.add("tuesday", sessions().maps[2])
    flags = {"localization_map": "map", "gather_evidence": True}
    session.run("localize", dry_run=True, **flags)
    assert session.maps.get("map").vi_map is updated()[0]
    session.run("localize", **flags)
    noted = read_evidence(session.maps.get("map").vi_map)
    expected, _ = gather_all(updated()[0], session=sessions().maps[2])
    np.testing.assert_array_equal(noted, read_evidence(expected))
    session.run("localize", **flags | {"localization_map": str(tmp_path / "map")})
    session.run("load", map_folder=tmp_path / "map", map_key="stored")
    np.testing.assert_array_equal(np.sort(read_evidence(session.vi_map)), np.sort(noted))
    session.run("update_map", session="tuesday")
    times = read_evidence(session.vi_map)["recent"]["time_s"]
    assert not ((times[:, 1:] == times[:, :-1]) & (times[:, 1:] > 0)).any()
    session.run("gather_evidence", forget=True)
    hits = [np.count_nonzero(read_evidence(session.vi_map)["recent"]["matched"])]
    session.maps.add("bare", with_evidence(session.vi_map, None))
    session.run("lc", gather_evidence=True)
    hits.append(np.count_nonzero(read_evidence(session.vi_map)["recent"]["matched"]))
    assert hits[1] > 0.9 * hits[0] > 100


def test_a_summary_map_tells_the_probability_of_each_landmark(tmp_path: Path) -> None:
    vi_map = updated()[0]
    assert make_summary_map(first(), SummaryMapOptions()).existence_percent is None
    summary = make_summary_map(vi_map, SummaryMapOptions(landmark_ids=True))
    write_summary_map(summary, tmp_path)
    again = read_summary_map(tmp_path)
    assert again.existence_percent is not None
    assert again.landmark_id is not None
    rows = vi_map.landmark_index.rows(again.landmark_id)
    now = float(session_times_s(vi_map).max())
    exists = existence(read_evidence(vi_map), PersistenceOptions(), at_s=now)[rows]
    assert 0.0 < exists.min() < exists.max()
    np.testing.assert_allclose(again.existence_percent, 100.0 * exists, atol=0.5)
    wrong = dataclasses.replace(summary, existence_percent=again.existence_percent[:-1])
    write_summary_map(wrong, tmp_path, overwrite=True)
    with pytest.raises(MapError, match=r"probabilities of \d+ landmarks"):
        read_summary_map(tmp_path)
    wrong = dataclasses.replace(summary, existence_percent=again.existence_percent + np.uint8(101))
    write_summary_map(wrong, tmp_path, overwrite=True)
    with pytest.raises(MapError, match=r"a landmark exists with a probability of \d+ %"):
        read_summary_map(tmp_path)


def with_floats(vi_map: VIMap) -> VIMap:
    """Return a map with descriptors of 64 numbers instead of 384 bits."""
    bits = np.unpackbits(vi_map.keypoints.descriptor, axis=1) - 0.5
    numbers = bits @ np.random.default_rng(0).normal(size=(bits.shape[1], 64))
    numbers /= np.linalg.norm(numbers, axis=1, keepdims=True)
    kind = (256, DescriptorDepth.FLOAT32, FeatureType.XFEAT)
    blocks = object_column(
        [
            tuple(DescriptorBlock(b.keypoints, *kind) for b in row)
            for row in vi_map.frames.descriptor_blocks
        ]
    )
    return vi_map.replace(
        frames=vi_map.frames.replace(descriptor_blocks=blocks),
        keypoints=vi_map.keypoints.replace(descriptor=numbers.astype(np.float32).view(np.uint8)),
        landmarks=vi_map.landmarks.replace(
            feature_type=np.full(len(vi_map.landmarks), FeatureType.XFEAT)
        ),
    )


def test_descriptors_may_be_numbers() -> None:
    vi_map, report = update_map(with_floats(first()), with_floats(sessions().maps[1]))
    assert check_consistency(vi_map).errors == ()
    assert report.sessions[0].matched >= 20
    assert report.sessions[0].false_match < 0.1
    with pytest.raises(EstimationError, match="descriptors"):
        update_map(first(), with_floats(sessions().maps[1]))
