"""Loop closures between the clouds of simulated sessions, their record, and the relaxed map."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.algorithms.cloud_registration.workflow import close_cloud_loops
from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.algorithms.loop_closure.listing import find_closures, list_closures
from maplab_py.algorithms.loop_closure.record_updates import remove_closures
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.errors import FlagError, UserError
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.resource_queries import without_resources
from tests.algorithms.cloud_registration.clouds import CORRIDOR, ROOM, edge_errors, session
from tests.simulation.small import simulated

OPTIONS = CloudClosureOptions()
AROUND = SessionOptions(duration_s=24.0, turns=1.8)
SHORT = session(ROOM, AROUND, rate_hz=1.0)
WALK = SessionOptions(
    kind="corridor", duration_s=60.0, turns=1.5, wall_distance_m=1.2, shake_m=0.02
)
TWO_ROOMS = WorldOptions(rooms=2, landmarks_per_room=300)
TOUR = SessionOptions(kind="loop", duration_s=60.0, turns=2.0, wall_distance_m=2.8)


def test_clouds_close_loops_that_a_relaxation_uses() -> None:
    data = simulated(SHORT)
    vi_map, report = close_cloud_loops(data.maps[0], Path(), OPTIONS)
    assert report.failure == ""
    assert report.clouds == 24
    assert report.edges_added == len(vi_map.loop_closure_edges) > 10
    off_m, off_deg = edge_errors(vi_map, data.truth)
    assert off_m.max() < 0.05
    assert off_deg.max() < 0.5
    relaxed, _ = relax(vi_map, RelaxationOptions())
    before = evaluate_map(data.maps[0], data.truth).ate_m
    assert evaluate_map(relaxed, data.truth).ate_m < 0.6 * before


def test_closures_are_recorded_and_removed_like_those_of_images() -> None:
    vi_map, report = close_cloud_loops(simulated(SHORT).maps[0], Path(), OPTIONS)
    closures = read_record(vi_map).closures
    assert len(closures) == report.pairs
    listed = list_closures(vi_map)
    assert listed.accepted == report.accepted == listed.shown
    assert {line.use for line in listed.closures} == {"edge"}
    assert max(line.gap_deg for line in listed.closures) < 15.0
    edge = vi_map.loop_closure_edges.id[0]
    removed, _ = remove_closures(vi_map, find_closures(vi_map, [to_hex(edge)]))
    assert len(removed.loop_closure_edges) == report.edges_added - 1
    again, second = close_cloud_loops(removed, Path(), OPTIONS)
    assert "removed by hand" in second.refused
    assert to_hex(edge) not in {to_hex(words) for words in again.loop_closure_edges.id}


def test_a_repeated_search_replaces_the_edges() -> None:
    vi_map, report = close_cloud_loops(simulated(SHORT).maps[0], Path(), OPTIONS)
    again, second = close_cloud_loops(vi_map, Path(), OPTIONS)
    assert second == report
    np.testing.assert_array_equal(again.loop_closure_edges.id, vi_map.loop_closure_edges.id)
    np.testing.assert_array_equal(again.loop_closure_edges.T_A_B, vi_map.loop_closure_edges.T_A_B)


def test_recorded_closures_name_the_pairs() -> None:
    vi_map, _ = close_cloud_loops(simulated(SHORT).maps[0], Path(), OPTIONS)
    options = dataclasses.replace(OPTIONS, from_closures=True, every_nth=2)
    again, report = close_cloud_loops(vi_map, Path(), options)
    assert 0 < report.accepted <= report.pairs
    off_m, _ = edge_errors(again, simulated(SHORT).truth)
    assert off_m.max() < 0.05


def test_strict_gates_refuse_and_say_so() -> None:
    vi_map = simulated(SHORT).maps[0]
    for options, reason in (
        (dataclasses.replace(OPTIONS, min_overlap=0.999), "clouds overlap too little"),
        (dataclasses.replace(OPTIONS, max_residual_m=1e-4), "clouds do not fit"),
        (dataclasses.replace(OPTIONS, min_constraint=0.9), "clouds do not fix the position"),
        (dataclasses.replace(OPTIONS, min_support=500), "no closures nearby agree"),
    ):
        few = dataclasses.replace(options, every_nth=3)
        unchanged, report = close_cloud_loops(vi_map, Path(), few)
        assert report.refused.keys() == {reason}
        assert reason in report.failure
        assert not len(unchanged.loop_closure_edges)


def test_maps_without_clouds_or_pairs() -> None:
    vi_map = simulated(SHORT).maps[0]
    bare = without_resources(vi_map, np.ones(len(vi_map.resources), dtype=np.bool_))
    with pytest.raises(UserError, match="import_point_clouds"):
        close_cloud_loops(bare, Path(), OPTIONS)
    with pytest.raises(UserError, match="no accepted closure"):
        close_cloud_loops(vi_map, Path(), dataclasses.replace(OPTIONS, from_closures=True))
    late = dataclasses.replace(OPTIONS, min_time_gap_s=100.0, sequence_gap_s=0.0)
    assert "--lidar_lc_min_time_gap_s" in close_cloud_loops(vi_map, Path(), late)[1].failure
    with pytest.raises(FlagError, match="exclude each other"):
        CloudClosureOptions(search_globally=True, from_closures=True)


@pytest.mark.slow
@pytest.mark.parametrize(("world", "motion"), [(TWO_ROOMS, TOUR), (CORRIDOR, WALK)])
def test_no_wrong_edges_over_twenty_seeds(world: WorldOptions, motion: SessionOptions) -> None:
    edges = 0
    for seed in range(20):
        data = simulate(session(world, motion, rate_hz=0.5, seed=seed))
        vi_map, report = close_cloud_loops(data.maps[0], Path(), OPTIONS)
        off_m, off_deg = edge_errors(vi_map, data.truth)
        assert off_m.max(initial=0.0) < 0.1
        assert off_deg.max(initial=0.0) < 1.0
        edges += report.edges_added
    assert edges > 100


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("world", "motion"), [(TWO_ROOMS, TOUR), (CORRIDOR, WALK)])
def test_a_drifting_minute_is_straightened(
    world: WorldOptions, motion: SessionOptions, seed: int
) -> None:
    data = simulate(session(world, motion, rate_hz=1.0, seed=seed))
    vi_map, _ = close_cloud_loops(data.maps[0], Path(), OPTIONS)
    relaxed, _ = relax(vi_map, RelaxationOptions())
    before = evaluate_map(data.maps[0], data.truth).ate_m
    assert evaluate_map(relaxed, data.truth).ate_m <= 0.25 * before


def test_clouds_in_sequence_limit_the_drift_where_no_loop_closes() -> None:
    """Without a place that is visited twice, only clouds that follow one another are compared."""
    once = session(ROOM, dataclasses.replace(AROUND, duration_s=9.0, turns=0.5), rate_hz=2.0)
    data = simulated(once)
    alone = dataclasses.replace(OPTIONS, sequence_gap_s=0.0)
    assert not len(close_cloud_loops(data.maps[0], Path(), alone)[0].loop_closure_edges)
    vi_map, report = close_cloud_loops(data.maps[0], Path(), OPTIONS)
    edges = vi_map.loop_closure_edges
    stamp_ns = vi_map.vertices.timestamp_ns
    gap_s = (stamp_ns[edges.from_vertex] - stamp_ns[edges.to_vertex]) * 1e-9
    assert set(np.abs(gap_s).round().tolist()) == {1.0, 2.0}
    assert report.edges_added > report.clouds
    assert edge_errors(vi_map, data.truth)[0].max() < 0.05
    relaxed, _ = relax(vi_map, RelaxationOptions())
    before = evaluate_map(data.maps[0], data.truth).ate_m
    assert evaluate_map(relaxed, data.truth).ate_m < 0.5 * before
