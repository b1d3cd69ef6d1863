from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.closure_record import FIELD_NUMBER, drop_record, read_record
from maplab_py.algorithms.loop_closure.listing import find_closures, list_closures, write_closures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import remove_closures
from maplab_py.algorithms.loop_closure.workflow import close_loops, insert_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax_over_loops
from maplab_py.errors import MapError, UserError
from maplab_py.storage.extension_fields import with_extension
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap.edits import remove_missions, with_new_ids
from maplab_py.vimap.merge import merge_maps
from tests.algorithms.loop_closure.rooms import Walk, make_map

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]


@pytest.fixture(scope="module")
def closed():
    vi_map, _ = make_map(TWICE)
    return vi_map, *close_loops(vi_map)


def original_landmarks(vi_map, before):
    """The landmark id that every keypoint observes."""
    return vi_map.landmarks.id[vi_map.keypoints.landmark]


def test_every_candidate_is_recorded_with_its_verdict(closed):
    _, merged, report = closed
    record = read_record(merged)
    assert len(record.closures) == report.candidates
    listed = list_closures(merged)
    assert listed.accepted == report.accepted
    assert listed.refused == report.refused
    assert {line.use for line in listed.closures} == {"merge"}
    assert sum(line.merged for line in listed.closures) > report.landmarks_merged
    for line in listed.closures:
        assert line.query_s != line.place_s
        assert line.gap_m == pytest.approx(line.correction_m, abs=0.06)


def test_refused_ones_tell_why():
    vi_map, _ = make_map(TWICE)
    merged, _ = close_loops(vi_map, LoopClosureOptions(min_inlier_count=1000))
    listed = list_closures(merged, which="refused")
    assert listed.accepted == 0
    assert listed.shown > 0
    assert {line.verdict for line in listed.closures} == {"too few inliers"}
    assert {line.use for line in listed.closures} == {""}


def test_the_record_is_saved_with_the_map_and_goes_with_its_mission(closed, tmp_path):
    _, merged, _ = closed
    save_map(merged, tmp_path / "map")
    loaded, _ = load_map(tmp_path / "map")
    for name, table in read_record(merged).tables().items():
        again = read_record(loaded).tables()[name]
        for column, array in table.columns().items():
            np.testing.assert_array_equal(again.columns()[column], array, err_msg=column)
    other = with_new_ids(make_map([Walk(room=5)])[0])
    both, _ = merge_maps(other, loaded)
    assert list_closures(both).recorded == list_closures(merged).recorded
    assert list_closures(remove_missions(both, [1])).recorded == 0


def test_removing_every_closure_gives_the_landmarks_back(closed):
    before, merged, report = closed
    ids = read_record(merged).closures.id
    split, removal = remove_closures(merged, ids)
    assert removal.landmarks_restored == report.landmarks_merged
    assert len(split.landmarks) == len(before.landmarks)
    np.testing.assert_array_equal(
        split.landmarks.id[split.keypoints.landmark],
        before.landmarks.id[before.keypoints.landmark],
    )
    row = before.landmark_index.rows(split.landmarks.id)
    np.testing.assert_array_equal(split.landmarks.p_I, before.landmarks.p_I[row])


def test_removing_one_closure_undoes_what_it_alone_decided(closed):
    _, merged, _ = closed
    first = list_closures(merged, sort_by="inliers").closures[0]
    ids = find_closures(merged, [first.id])
    split, removal = remove_closures(merged, ids)
    assert removal.closures == (first.id,)
    record = read_record(split)
    assert not np.any(np.all(record.pairs.closure == ids[0], axis=1))
    assert len(split.landmarks) == len(merged.landmarks) + removal.landmarks_restored
    refused = list_closures(split, which="refused").closures
    assert [line.verdict for line in refused if line.id == first.id] == ["removed by hand"]
    # what still hangs together did so before, and no frame holds a landmark twice
    assert removal.landmarks_restored < 60
    pairs = np.stack([split.keypoint_frame, split.keypoints.landmark], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)


def test_a_removed_closure_is_not_found_again(closed):
    before, merged, _ = closed
    ids = read_record(merged).closures.id
    split, _ = remove_closures(merged, ids)
    again, report = close_loops(split)
    assert report.accepted == 0
    assert report.refused["removed by hand"] > 0
    assert len(again.landmarks) == len(before.landmarks)
    free, report = close_loops(drop_record(split))
    assert report.accepted > 0
    assert len(free.landmarks) < len(before.landmarks)


def test_removal_takes_the_edge_and_its_neighbours():
    vi_map, _ = make_map(TWICE)
    with_edges, report = insert_edges(vi_map)
    line = list_closures(with_edges).closures[3]
    one, removal = remove_closures(with_edges, find_closures(with_edges, [line.id]))
    assert removal.edges_removed == 1
    assert len(one.loop_closure_edges) == report.edges_added - 1
    near = find_closures(with_edges, [line.id], neighbours_s=1.0)
    assert 1 < len(near) < report.edges_added
    _, removal = remove_closures(with_edges, near)
    assert removal.edges_removed == len(near)


def test_relax_records_what_it_left_of_each_closure():
    vi_map, _ = make_map(TWICE)
    relaxed, _, report = relax_over_loops(vi_map, RelaxationOptions(), LoopClosureOptions())
    lines = list_closures(relaxed).closures
    assert sum(line.use == "relax" for line in lines) == report.num_loop_closures
    assert max(line.gap_m for line in lines) < 0.1
    assert all(line.weight > 0.9 for line in lines)
    assert len(relaxed.loop_closure_edges) == 0
    _, removal = remove_closures(relaxed, find_closures(relaxed, [lines[0].id]))
    assert "run relax again" in removal.notes[0]


def test_wrong_prefixes_are_errors(closed):
    _, merged, _ = closed
    with pytest.raises(UserError, match="lc_report"):
        find_closures(merged, ["zz"])
    with pytest.raises(UserError, match="lc_report"):
        find_closures(merged, [""])


def test_json_and_csv_hold_the_same_lines(closed, tmp_path: Path):
    _, merged, _ = closed
    report = list_closures(merged, which="all")
    write_closures(report, tmp_path / "a.json", overwrite=False)
    write_closures(report, tmp_path / "a.csv", overwrite=False)
    lines = json.loads((tmp_path / "a.json").read_text())["closures"]
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert len(lines) == len(rows) - 1 == report.recorded
    assert rows[1].split(",")[0] == lines[0]["id"]
    with pytest.raises(UserError, match="--overwrite"):
        write_closures(report, tmp_path / "a.csv", overwrite=False)
    with pytest.raises(UserError, match=r"\.json or \.csv"):
        write_closures(report, tmp_path / "a.txt", overwrite=False)


def test_a_damaged_record_is_told_and_can_be_dropped(closed):
    _, merged, _ = closed
    unknown = merged.missions.unknown.copy()
    unknown[0] = with_extension(b"", FIELD_NUMBER, b"LC1nonsense")
    damaged = merged.replace(missions=merged.missions.replace(unknown=unknown))
    with pytest.raises(MapError, match="delete_loopclosure_record"):
        read_record(damaged)
    assert read_record(drop_record(damaged)).is_empty
