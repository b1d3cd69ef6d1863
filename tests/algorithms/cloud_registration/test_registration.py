"""Pairs of simulated clouds against their true poses, and loop closures between sessions by clouds."""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.cloud_registration import registration, workflow
from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions, CloudClosureReport
from maplab_py.algorithms.loop_closure import closure_record, record_updates
from maplab_py.algorithms.loop_closure.listing import find_closures, list_closures
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax
from maplab_py.array_types import F64
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.simulate import Lidar, simulate
from maplab_py.simulation.truth import Truth
from maplab_py.simulation.world import World, make_world
from maplab_py.vimap import IdIndex, VIMap, to_hex, without_resources
from tests.simulation.small import simulated

ROOM = sim.WorldOptions(landmarks_per_room=200)
LONG_CORRIDOR = sim.WorldOptions(
    layout="corridor", room_size_m=(90.0, 70.0, 3.0), furniture_per_room=0, landmarks_per_room=200
)
CORRIDOR = dataclasses.replace(LONG_CORRIDOR, room_size_m=(16.0, 12.0, 3.0), landmarks_per_room=600)
_APART_M = 3.0


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds, the true pose of the source in the target, and an initial one that is off."""

    target: F64  # (N, 3)
    source: F64  # (M, 3)
    T_T_S: F64  # (7,)
    start: F64  # (7,)


def pairs(options: sim.WorldOptions, count: int, seed: int = 0) -> Iterator[Pair]:
    """Yield pairs of up to 3 m distance, with starts off by 0.5 m and 10 deg."""
    rng = np.random.default_rng(seed)
    world = make_world(options, rng)
    lidar = Lidar.of(world, sim.LidarOptions(rate_hz=1.0), rng)
    for _ in range(count):
        a = _free_position(world, rng)
        b = _free_position(world, rng)
        while np.linalg.norm(a - b) > _APART_M:
            a, b = _free_position(world, rng), _free_position(world, rng)
        poses = [_pose(p, rng) for p in (a, b)]
        T_T_S = se3.relative(*poses)
        error = se3.make(so3.exp(_of_length(np.deg2rad(10.0), rng)), _of_length(0.5, rng))
        clouds = [lidar.scan(pose, rng).p for pose in poses]
        yield Pair(clouds[0], clouds[1], T_T_S, se3.compose(T_T_S, error))


def _free_position(world: World, rng: np.random.Generator) -> F64:
    low, high = world.bounds
    while True:
        p = rng.uniform(low + 0.8, high - 0.8)
        p[2] = rng.uniform(1.0, 2.0)
        inside = (p > world.boxes[:, 0] - 0.3) & (p < world.boxes[:, 1] + 0.3)
        if not inside.all(axis=1).any():
            return p


def _pose(p: F64, rng: np.random.Generator) -> F64:
    tilt = rng.normal(0.0, 0.03, 2)
    return se3.make(so3.exp([*tilt, rng.uniform(-np.pi, np.pi)]), p)


def _of_length(length: float, rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return v * (length / np.linalg.norm(v))


def errors(T_A_B: F64, estimate: F64) -> tuple[float, float]:
    """Return the distance [m] and the angle [deg] between two poses (7,)."""
    e = se3.local(T_A_B, estimate)
    return float(np.linalg.norm(e[:3])), float(np.degrees(np.linalg.norm(e[3:])))


def session(
    world: sim.WorldOptions, motion: sim.SessionOptions, *, rate_hz: float, seed: int = 1
) -> sim.Scenario:
    """Return a drifting session with a lidar and few landmarks."""
    return sim.Scenario(
        world=world,
        sessions=(motion,),
        lidar=sim.LidarOptions(rate_hz=rate_hz),
        measurement=sim.MeasurementOptions(max_keypoints=30),
        drift=sim.DriftOptions(yaw_walk_deg=0.5, position_walk=0.03),
    ).with_seed(seed)


def edge_errors(vi_map: VIMap, truth: Truth) -> tuple[F64, F64]:
    """Return the errors [m, deg] of the loop closure edges (E,) of a map."""
    edges = vi_map.loop_closure_edges
    T_G_I = truth.T_G_I[IdIndex(truth.vertex_id).rows(vi_map.vertices.id)]
    T_A_B = se3.relative(T_G_I[edges.from_vertex], T_G_I[edges.to_vertex])
    e = se3.local(T_A_B, edges.T_A_B)
    return np.linalg.norm(e[:, :3], axis=1), np.degrees(np.linalg.norm(e[:, 3:], axis=1))


OPTIONS = CloudClosureOptions()


def _prepared(pair: Pair) -> tuple[registration.PreparedCloud, registration.PreparedCloud]:
    voxel_m = OPTIONS.voxel_size_m
    return registration.prepare_cloud(pair.target, voxel_m, "a"), registration.prepare_cloud(
        pair.source, voxel_m, "b"
    )


def _registered(pair: Pair) -> registration.Registration:
    return registration.register_clouds(*_prepared(pair), pair.start, OPTIONS.max_correspondence_m)


def _share_registered(count: int, seeds: int) -> float:
    good = []
    for seed in range(seeds):
        for pair in pairs(ROOM, count // seeds, seed):
            off_m, off_deg = errors(pair.T_T_S, _registered(pair).T_T_S)
            good.append(off_m < 0.02 and off_deg < 0.2)
    return float(np.mean(good))


def test_clouds_of_a_room_are_registered() -> None:
    assert _share_registered(8, 2) == 1.0


@pytest.mark.slow
def test_many_pairs_of_clouds() -> None:
    assert _share_registered(60, 6) >= 0.98


def test_a_true_pose_fits_and_others_do_not() -> None:
    pair = next(pairs(ROOM, 1, seed=3))
    target, source = _prepared(pair)
    fit = registration.describe_fit(target, source, pair.T_T_S, OPTIONS.max_correspondence_m)
    true = workflow.compare_clouds(target, source, pair.T_T_S)
    assert fit.residual_m < OPTIONS.max_residual_m
    assert fit.constraint > OPTIONS.min_constraint
    assert true.overlap > 0.8
    assert true.conflict < 0.01
    turned = se3.compose(pair.T_T_S, se3.make(so3.exp([0.0, 0.0, 0.8]), np.array([2.0, 1.0, 0.0])))
    wrong = workflow.compare_clouds(target, source, turned)
    assert wrong.overlap < true.overlap - 0.2 or wrong.conflict > 0.05


def test_a_bare_corridor_does_not_fix_the_position_along_its_axis() -> None:
    """Pairs that pass the gate are right; there are some that are wrong, and the gate refuses them."""
    slid = 0
    for pair in pairs(LONG_CORRIDOR, 14, seed=1):
        fit = _registered(pair)
        off_m, _ = errors(pair.T_T_S, fit.T_T_S)
        slid += off_m > 0.1
        assert off_m < 0.03 or fit.constraint < OPTIONS.min_constraint
    assert slid > 0


def test_the_information_has_the_size_of_the_errors() -> None:
    """Squared errors are some tens of times too large at most: points err together."""
    squared = []
    for pair in pairs(ROOM, 10, seed=5):
        fit = _registered(pair)
        error = se3.local(pair.T_T_S, fit.T_T_S)
        error[:3] = so3.rotate(so3.inverse(pair.T_T_S[:4]), error[:3])
        squared.append(error @ fit.information @ error)
    assert 0.3 < np.median(squared) < 30.0


def test_global_registration_needs_no_initial_pose() -> None:
    count = 0
    for pair in pairs(ROOM, 4, seed=2):
        target, source = _prepared(pair)
        start = workflow.register_globally(target, source, OPTIONS.voxel_size_m)
        if start is None:
            continue
        fit = registration.register_clouds(target, source, start, OPTIONS.max_correspondence_m)
        off_m, off_deg = errors(pair.T_T_S, fit.T_T_S)
        count += off_m < 0.05 and off_deg < 0.5
    assert count >= 2


def test_a_cloud_with_few_points_is_refused() -> None:
    with pytest.raises(MapError, match="--lidar_lc_voxel_size_m"):
        registration.prepare_cloud(np.random.default_rng(1).normal(size=(50, 3)), 0.1, "cloud abc")


AROUND = sim.SessionOptions(duration_s=24.0, turns=1.8)
SHORT = session(ROOM, AROUND, rate_hz=1.0)
WALK = sim.SessionOptions(
    kind="corridor", duration_s=60.0, turns=1.5, wall_distance_m=1.2, shake_m=0.02
)
TWO_ROOMS = sim.WorldOptions(rooms=2, landmarks_per_room=300)
TOUR = sim.SessionOptions(kind="loop", duration_s=60.0, turns=2.0, wall_distance_m=2.8)


@functools.cache
def closed() -> tuple[VIMap, CloudClosureReport]:
    """Return the short walk with the loops that its clouds close, and the report."""
    return workflow.close_cloud_loops(simulated(SHORT).maps[0], Path(), OPTIONS)


def test_clouds_close_loops_that_a_relaxation_uses() -> None:
    data = simulated(SHORT)
    vi_map, report = closed()
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
    vi_map, report = closed()
    closures = closure_record.read_record(vi_map).closures
    assert len(closures) == report.pairs
    listed = list_closures(vi_map)
    assert listed.accepted == report.accepted == listed.shown
    assert {line.use for line in listed.closures} == {"edge"}
    assert max(line.gap_deg for line in listed.closures) < 15.0
    edge = vi_map.loop_closure_edges.id[0]
    removed, _ = record_updates.remove_closures(vi_map, find_closures(vi_map, [to_hex(edge)]))
    assert len(removed.loop_closure_edges) == report.edges_added - 1
    again, second = workflow.close_cloud_loops(removed, Path(), OPTIONS)
    assert "removed by hand" in second.refused
    assert to_hex(edge) not in {to_hex(words) for words in again.loop_closure_edges.id}


def test_a_repeated_search_replaces_the_edges() -> None:
    vi_map, report = closed()
    again, second = workflow.close_cloud_loops(vi_map, Path(), OPTIONS)
    assert second == report
    np.testing.assert_array_equal(again.loop_closure_edges.id, vi_map.loop_closure_edges.id)
    np.testing.assert_array_equal(again.loop_closure_edges.T_A_B, vi_map.loop_closure_edges.T_A_B)


def test_recorded_closures_name_the_pairs() -> None:
    vi_map, _ = closed()
    options = dataclasses.replace(OPTIONS, from_closures=True, every_nth=2)
    again, report = workflow.close_cloud_loops(vi_map, Path(), options)
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
        unchanged, report = workflow.close_cloud_loops(vi_map, Path(), few)
        assert report.refused.keys() == {reason}
        assert reason in report.failure
        assert not len(unchanged.loop_closure_edges)


def test_maps_without_clouds_or_pairs() -> None:
    vi_map = simulated(SHORT).maps[0]
    bare = without_resources(vi_map, np.ones(len(vi_map.resources), dtype=np.bool_))
    with pytest.raises(UserError, match="import_point_clouds"):
        workflow.close_cloud_loops(bare, Path(), OPTIONS)
    with pytest.raises(UserError, match="no accepted closure"):
        workflow.close_cloud_loops(vi_map, Path(), dataclasses.replace(OPTIONS, from_closures=True))
    late = dataclasses.replace(OPTIONS, min_time_gap_s=100.0, sequence_gap_s=0.0)
    assert (
        "--lidar_lc_min_time_gap_s" in workflow.close_cloud_loops(vi_map, Path(), late)[1].failure
    )
    with pytest.raises(FlagError, match="exclude each other"):
        CloudClosureOptions(search_globally=True, from_closures=True)


@pytest.mark.slow
@pytest.mark.parametrize(("world", "motion"), [(TWO_ROOMS, TOUR), (CORRIDOR, WALK)])
def test_no_wrong_edges_over_seeds(world: sim.WorldOptions, motion: sim.SessionOptions) -> None:
    edges = 0
    for seed in range(6):
        data = simulate(session(world, motion, rate_hz=0.35, seed=seed))
        vi_map, report = workflow.close_cloud_loops(data.maps[0], Path(), OPTIONS)
        off_m, off_deg = edge_errors(vi_map, data.truth)
        assert off_m.max(initial=0.0) < 0.1
        assert off_deg.max(initial=0.0) < 1.0
        edges += report.edges_added
    assert edges > 30


def test_clouds_in_sequence_limit_the_drift_where_no_loop_closes() -> None:
    """Without a place that is visited twice, only clouds that follow one another are compared."""
    once = session(ROOM, dataclasses.replace(AROUND, duration_s=9.0, turns=0.5), rate_hz=2.0)
    data = simulated(once)
    alone = dataclasses.replace(OPTIONS, sequence_gap_s=0.0)
    assert not len(workflow.close_cloud_loops(data.maps[0], Path(), alone)[0].loop_closure_edges)
    vi_map, report = workflow.close_cloud_loops(data.maps[0], Path(), OPTIONS)
    edges = vi_map.loop_closure_edges
    stamp_ns = vi_map.vertices.timestamp_ns
    gap_s = (stamp_ns[edges.from_vertex] - stamp_ns[edges.to_vertex]) * 1e-9
    assert set(np.abs(gap_s).round().tolist()) == {1.0, 2.0}
    assert report.edges_added > report.clouds
    assert edge_errors(vi_map, data.truth)[0].max() < 0.05
    relaxed, _ = relax(vi_map, RelaxationOptions())
    before = evaluate_map(data.maps[0], data.truth).ate_m
    assert evaluate_map(relaxed, data.truth).ate_m < 0.5 * before
