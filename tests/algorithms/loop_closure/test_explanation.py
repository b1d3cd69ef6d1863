"""The record of closures, and why each of them was refused."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.gate import Gate, failures
from maplab_py.algorithms.loop_closure.closure_record import (
    FIELD_NUMBER,
    drop_record,
    read_record,
    write_record,
)
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.explanation import (
    acceptance,
    explain_closure,
    explain_mission,
    explain_pair,
)
from maplab_py.algorithms.loop_closure.gates import closure_gates
from maplab_py.algorithms.loop_closure.listing import (
    accepted_by_mission,
    find_closures,
    list_closures,
    write_closures,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.record_updates import remove_closures
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.workflow import close_loops, insert_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax_over_loops
from maplab_py.errors import MapError, UserError
from maplab_py.storage.extension_fields import with_extension
from maplab_py.storage.native import load_map, save_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import remove_missions, with_new_ids
from maplab_py.vimap.ids import IdIndex
from maplab_py.vimap.merge import merge_maps
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.data import shared_data

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]


@pytest.fixture(scope="module")
def closed():
    vi_map, _ = make_map(TWICE)
    return vi_map, *close_loops(vi_map)


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


OPTIONS = LoopClosureOptions()
DRIFT = (0.2, -0.1, 0.05, 0.01)
ACCEPTED = VERDICTS.index(Verdict.ACCEPTED)


def closed_loops(walks: list[Walk], **options: float) -> VIMap:
    return close_loops(make_map(walks)[0], dataclasses.replace(OPTIONS, **options))[0]


@pytest.fixture(scope="module")
def strict() -> VIMap:
    """Return a map whose closures were refused by a gate that is far too strict."""
    walks = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)]
    return closed_loops(walks, min_inlier_count=1000)


def test_a_refused_closure_names_its_gates_with_their_flags(strict: VIMap) -> None:
    options = dataclasses.replace(OPTIONS, min_inlier_count=1000)
    report = explain_closure(strict, 0, options)
    (failed,) = [line for line in report.gates if line.result == "failed"]
    assert failed.flag == "--lc_min_inlier_count"
    assert failed.wanted == "at least 1000"
    assert float(failed.value) == read_record(strict).closures.inliers[0]
    inliers = read_record(strict).closures.inliers[0]
    assert f"--lc_min_inlier_count={inliers} would accept it" in report.summary
    with_defaults = explain_closure(strict, 0, OPTIONS)
    assert with_defaults.gates[-1].result == "failed"


@pytest.mark.parametrize(
    "too_strict",
    [
        {"min_inlier_count": 1000, "min_support": 30},
        {"max_rotation_sigma_deg": 1e-6},
    ],
)
def test_the_flags_that_it_names_accept_it(too_strict: dict[str, float]) -> None:
    walks = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)]
    options = dataclasses.replace(OPTIONS, **too_strict)
    vi_map = closed_loops(walks, **too_strict)
    record = read_record(vi_map).closures
    for row in np.linspace(0, len(record) - 1, 5).astype(int).tolist():
        report = explain_closure(vi_map, row, options)
        named = dict(re.findall(r"--lc_(\w+)=([0-9.e+-]*\d)", report.summary))
        assert named
        moved = {name: type(getattr(OPTIONS, name))(float(value)) for name, value in named.items()}
        after = read_record(closed_loops(walks, **(too_strict | moved))).closures
        same = (after.query == record.query[row]).all(axis=1)
        same &= (after.place == record.place[row]).all(axis=1)
        verdicts = {VERDICTS[verdict] for verdict in after.verdict[same].tolist()}
        assert verdicts == {Verdict.ACCEPTED}


def test_a_contradicted_closure_names_the_difference_at_which_it_agrees() -> None:
    walks = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)]
    vi_map = closed_loops(walks)
    record = read_record(vi_map)
    T_A_B, verdict = record.closures.T_A_B.copy(), record.closures.verdict.copy()
    difference = record.closures.difference.copy()
    row = len(verdict) // 2
    T_A_B[row, 4:] += [0.0, 0.0, 0.5]
    verdict[row], difference[row] = VERDICTS.index(Verdict.CONTRADICTED), 1.5
    closures = record.closures.replace(T_A_B=T_A_B, verdict=verdict, difference=difference)
    vi_map = write_record(vi_map, dataclasses.replace(record, closures=closures))
    report = explain_closure(vi_map, row, OPTIONS)
    (failed,) = [line for line in report.gates if line.result == "failed"]
    assert failed.flag == "--lc_max_neighbour_difference"
    assert float(failed.value) > 1.0
    # the flag comes from judging again: the changed pose is farther off than what was recorded
    named = re.search(rf"{failed.flag}=([0-9.]+) would accept it", report.summary)
    assert named is not None
    assert 1.6 < float(named[1]) < 4.0
    moved_options = dataclasses.replace(OPTIONS, max_neighbour_difference=1.6)
    assert "would pass" in explain_closure(vi_map, row, moved_options).summary


def test_a_closure_that_passes_since_the_map_was_relaxed_is_none_of_the_others() -> None:
    vi_map = closed_loops([Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)])
    closures = read_record(vi_map).closures
    row = len(closures) // 2
    verdict, difference = closures.verdict.copy(), closures.difference.copy()
    verdict[row], difference[row] = VERDICTS.index(Verdict.CONTRADICTED), 1.5  # as it once was
    closures = closures.replace(verdict=verdict, difference=difference)
    found = acceptance(vi_map, closures, row, OPTIONS)
    assert found is not None
    assert (found.verdict, found.others) == (Verdict.ACCEPTED, 0)


def test_pairs_and_missions(strict: VIMap) -> None:
    options = dataclasses.replace(OPTIONS, min_inlier_count=1000)
    unknown = np.zeros(len(strict.baseframes), dtype=np.bool_)
    free = strict.replace(baseframes=strict.baseframes.replace(is_known=unknown))
    pair = explain_pair(free, 0, 1, options, 4)
    assert pair.accepted == 0
    assert pair.gates[0].flag == "--lc_min_inlier_count"
    assert pair.gates[0].failed == pair.closures
    assert pair.gates[-1].flag == "--anchor_transform_min_inlier_count"
    assert [miss.gates_failed for miss in pair.nearest] == sorted(
        miss.gates_failed for miss in pair.nearest
    )
    mission = explain_mission(strict, 0)
    assert mission.pairs[0].refused == pair.closures
    assert mission.pairs[0].most_refused_for == Verdict.FEW_INLIERS.value


def test_missions_without_a_record_are_searched_and_stay_as_they_are() -> None:
    vi_map = make_map([Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)])[0]
    vi_map = close_loops(vi_map, dataclasses.replace(OPTIONS, min_inlier_count=1000))[0]
    from maplab_py.algorithms.loop_closure.closure_record import drop_record

    dropped = drop_record(vi_map)
    pair = explain_pair(dropped, 0, 1, OPTIONS, 4)
    assert pair.closures > 0
    assert "changed nothing" in pair.summary
    assert len(read_record(dropped).closures) == 0


def test_missions_that_see_nothing_in_common() -> None:
    vi_map = make_map([Walk(room=1), Walk(room=2, mission=1, start_s=60.0)])[0]
    vi_map = close_loops(vi_map)[0]
    pair = explain_pair(vi_map, 0, 1, OPTIONS, 4)
    assert pair.accepted == 0
    assert pair.gates
    assert pair.gates[0].flag.startswith("--lc_")


def test_near_misses_and_reasons_select_and_sort(strict: VIMap) -> None:
    few = list_closures(strict, which="refused", reason="inliers", sort_by="near_miss")
    assert few.closures
    assert {line.verdict for line in few.closures} == {Verdict.FEW_INLIERS.value}
    inliers = [line.inliers for line in list_closures(
        strict, which="refused", sort_by="inliers", descending=True
    ).closures]  # fmt: skip
    assert inliers == sorted(inliers, reverse=True)
    with pytest.raises(UserError, match="no verdict contains this text"):
        list_closures(strict, reason="weather")
    assert accepted_by_mission(strict).tolist() == [0, 0]


def reference(vi_map: VIMap) -> tuple[list[Gate], np.ndarray]:
    closures = read_record(vi_map).closures
    gates = closure_gates(closures, OPTIONS)
    return gates, closures.verdict


def moved(flags: tuple[str, ...]) -> LoopClosureOptions:
    """Return the options with flags of `lc` set."""
    pairs = [flag.removeprefix("--lc_").split("=") for flag in flags]
    values = {name: type(getattr(OPTIONS, name))(float(value)) for name, value in pairs}
    return dataclasses.replace(OPTIONS, **values)


def euroc() -> VIMap:
    from maplab_py.console.session.session import Session

    session = Session()
    session.run("load_merge_all_submaps", maps_folder=shared_data("maplab_maps/euroc_v1_01"))
    return session.vi_map


@pytest.mark.slow
def test_moving_the_named_flags_accepts_closures_of_the_tango_map() -> None:
    vi_map = load_map(shared_data("maplab_maps/tango_handheld"))[0]
    assert_that_named_flags_accept(vi_map, closures=2)


def assert_that_named_flags_accept(vi_map: VIMap, closures: int) -> None:
    """Every refused closure fails a gate; with the named flags a search accepts the nearest ones."""
    searched = close_loops(vi_map)[0]
    gates, verdict = reference(searched)
    failed = np.any([gate.failed for gate in gates], axis=0)
    assert np.array_equal(failed, verdict != ACCEPTED)
    no_flag = np.any([gate.failed for gate in gates if not gate.flag], axis=0)
    rows = np.flatnonzero(failed & ~no_flag)
    rows = rows[np.argsort(failures(gates)[1][rows], kind="stable")][:closures]
    assert len(rows) == closures
    recorded = read_record(searched).closures
    for row in rows.tolist():
        expected = acceptance(searched, recorded, row, OPTIONS)
        assert expected is not None
        record = read_record(close_loops(vi_map, moved(expected.flags))[0]).closures
        after = VERDICTS[record.verdict[IdIndex(record.id).rows(recorded.id[[row]])[0]]]
        assert (expected.verdict, after) == (Verdict.ACCEPTED, Verdict.ACCEPTED), (row, expected)
