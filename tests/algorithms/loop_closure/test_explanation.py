"""Every refused closure has a failed gate, and moving its flags accepts it."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from maplab_py.algorithms.gate import Gate, failures
from maplab_py.algorithms.loop_closure.closure_record import read_record, write_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.explanation import (
    acceptance,
    explain_closure,
    explain_mission,
    explain_pair,
)
from maplab_py.algorithms.loop_closure.gates import closure_gates
from maplab_py.algorithms.loop_closure.listing import accepted_by_mission, list_closures
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.errors import UserError
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.support.data import shared_data

OPTIONS = LoopClosureOptions()
DRIFT = (0.2, -0.1, 0.05, 0.01)
ACCEPTED = VERDICTS.index(Verdict.ACCEPTED)


def closed(walks: list[Walk], **options: float) -> VIMap:
    return close_loops(make_map(walks)[0], dataclasses.replace(OPTIONS, **options))[0]


@pytest.fixture(scope="module")
def strict() -> VIMap:
    """Return a map whose closures were refused by a gate that is far too strict."""
    walks = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)]
    return closed(walks, min_inlier_count=1000)


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
    vi_map = closed(walks, **too_strict)
    record = read_record(vi_map).closures
    for row in np.linspace(0, len(record) - 1, 5).astype(int).tolist():
        report = explain_closure(vi_map, row, options)
        named = dict(re.findall(r"--lc_(\w+)=([0-9.e+-]*\d)", report.summary))
        assert named
        moved = {name: type(getattr(OPTIONS, name))(float(value)) for name, value in named.items()}
        after = read_record(closed(walks, **(too_strict | moved))).closures
        same = (after.query == record.query[row]).all(axis=1)
        same &= (after.place == record.place[row]).all(axis=1)
        verdicts = {VERDICTS[verdict] for verdict in after.verdict[same].tolist()}
        assert verdicts == {Verdict.ACCEPTED}


def test_a_contradicted_closure_names_the_difference_at_which_it_agrees() -> None:
    walks = [Walk(room=1), Walk(room=1, mission=1, start_s=60.0, drift=DRIFT)]
    vi_map = closed(walks)
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


@pytest.mark.slow
def test_moving_the_named_flags_accepts_closures_of_a_real_map() -> None:
    assert_that_named_flags_accept(euroc(), closures=10)


def euroc() -> VIMap:
    from maplab_py.console.session.session import Session

    session = Session()
    session.run("load_merge_all_submaps", maps_folder=shared_data("maplab_maps/euroc_v1_01"))
    return session.vi_map


@pytest.mark.slow
def test_moving_the_named_flags_accepts_closures_of_the_tango_map() -> None:
    vi_map = load_map(shared_data("maplab_maps/tango_handheld"))[0]
    assert_that_named_flags_accept(vi_map, closures=10)


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
