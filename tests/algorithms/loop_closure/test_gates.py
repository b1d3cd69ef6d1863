"""Gates and consensus on closures made by hand, places that look alike, edges of what is accepted."""

import dataclasses
from functools import cache
from types import SimpleNamespace

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.closure_table import (
    VERDICTS,
    Closures,
    GateValues,
    closure_edges,
)
from maplab_py.algorithms.loop_closure.consensus import check_consensus
from maplab_py.algorithms.loop_closure.gates import judge, measure, rival_shares
from maplab_py.algorithms.loop_closure.merging import Votes, count_pairs
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.geometry import se3, so3
from maplab_py.vimap import BaseFrames, Missions, Vertices, VIMap
from maplab_py.vimap.ids import random_ids
from maplab_py.vision.absolute_pose import PoseSolutions
from tests.algorithms.loop_closure.rooms import Walk, make_map

COUNT = 40
PLACE = 100
"""The first vertex of the second lap."""


def two_laps() -> VIMap:
    """Return one mission that walks a line of 10 m twice, the same poses both times."""
    rng = np.random.default_rng(0)
    x = np.tile(np.linspace(0.0, 10.0, PLACE), 2)
    T_M_I = se3.make(so3.identity(2 * PLACE), np.stack([x, 0.0 * x, 0.0 * x], axis=1))
    return VIMap(
        missions=Missions.filled(1, id=random_ids(1, rng), baseframe=[0], root_vertex=[0]),
        baseframes=BaseFrames.filled(1, id=random_ids(1, rng), is_known=[True]),
        vertices=Vertices.filled(
            2 * PLACE,
            id=random_ids(2 * PLACE, rng),
            mission=np.zeros(2 * PLACE),
            T_M_I=T_M_I,
            timestamp_ns=(np.arange(2 * PLACE) * 10**9),
        ),
    )


def solutions(vi_map: VIMap, query: np.ndarray, *, off_m: np.ndarray) -> PoseSolutions:
    """Return poses of the queries, some of them off to the side."""
    T_M_I = vi_map.vertices.T_M_I[query].copy()
    T_M_I[:, 5] += off_m
    count = len(query)
    return PoseSolutions(
        T_M_I,
        np.full(count, 40),
        np.full(count, 60),
        np.ones(0, dtype=bool),
        np.tile(np.diag([1e-4] * 3 + [1e-6] * 3), (count, 1, 1)),
        np.zeros(count),
    )


def judged(found: PoseSolutions, query: np.ndarray, **options: float) -> GateValues:
    vi_map, place = two_laps(), query + PLACE
    measured = measure(vi_map, query, place, found, np.array([True]))
    return judge(vi_map, query, place, found.T_M_I, measured, LoopClosureOptions(**options))[0]


def verdicts(judged: GateValues) -> list[Verdict]:
    return [VERDICTS[row] for row in judged.verdict]


def test_tilted_closures_are_refused_and_say_so() -> None:
    query = np.arange(COUNT)
    good = solutions(two_laps(), query, off_m=np.zeros(COUNT))
    tilt_rad = np.zeros(COUNT)
    tilt_rad[7], tilt_rad[9] = np.deg2rad(3.01), np.deg2rad(2.99)
    found = verdicts(judged(dataclasses.replace(good, tilt_rad=tilt_rad), query))
    assert found[7] is Verdict.TILTED
    assert {one for row, one in enumerate(found) if row != 7} == {Verdict.ACCEPTED}
    wider = verdicts(
        judged(dataclasses.replace(good, tilt_rad=tilt_rad), query, max_gravity_deviation_deg=4.0)
    )
    assert set(wider) == {Verdict.ACCEPTED}


def consensus(query: list[int], place: list[int], off_m: list[float], inliers: list[int]):
    """Return support, which closures are supported by two or need no support, and contradicted ones."""
    vi_map = two_laps()
    T_M_I = solutions(vi_map, np.array(query), off_m=np.array(off_m)).T_M_I
    support, difference = check_consensus(
        vi_map, np.array(query), np.array(place), T_M_I, np.array(inliers)
    )
    return support, (support >= 2) | np.isnan(difference), difference >= 1.0


def test_a_query_does_not_support_itself() -> None:
    # one query with four places, all alike: nobody else says so
    support, supported, contradicted = consensus(
        [10] * 4, [110, 111, 112, 113], [0.0] * 4, [40] * 4
    )
    assert support.tolist() == [0] * 4
    assert not supported.any()
    assert not contradicted.any()
    # two other queries nearby support each of its closures, and it counts once for each of them
    support, supported, _ = consensus(
        [10, 10, 10, 12, 14], [110, 111, 112, 112, 114], [0.0] * 5, [40] * 5
    )
    assert support[:3].tolist() == [2, 2, 2]
    assert supported.all()


def test_support_by_closures_that_are_contradicted_themselves_does_not_count() -> None:
    # 20, 21, 22 agree that all is in place; 19 and 24 are off and have each other and nobody else.
    # In the first round 19 and 24 support each other, though both are contradicted.
    query, place = [19, 20, 21, 22, 24], [119, 120, 121, 122, 124]
    off_m = [3.0, 0.0, 0.0, 0.0, 3.0]
    support, supported, contradicted = consensus(query, place, off_m, [40] * 5)
    assert contradicted.tolist() == [True, False, False, False, True]
    assert support[1:4].tolist() == [2, 2, 2]
    assert supported[1:4].all()
    assert support[[0, 4]].tolist() == [0, 0]


def test_a_strong_wrong_closure_does_not_take_right_ones_with_it() -> None:
    # the wrong one has more inliers than any right one that it speaks against, but less than all of
    # those that speak against it: once it is out, nobody speaks against a right one far from others
    query, place = [20, 38, 50, 51], [120, 138, 150, 151]
    off_m = [0.0, 3.0, 0.0, 0.0]
    support, supported, contradicted = consensus(query, place, off_m, [40, 150, 100, 100])
    assert contradicted.tolist() == [False, True, False, False]
    assert supported.tolist() == [True, False, True, True]
    assert support.tolist() == [2, 0, 2, 2]


def test_a_closure_alone_needs_many_inliers_and_nobody_against_it() -> None:
    for inliers, is_supported in ((49, False), (50, True)):
        assert consensus([10], [110], [0.0], [inliers])[1].tolist() == [is_supported]
    # one of those that it contradicts is within three metres; the others say that this one is right
    _, supported, contradicted = consensus(
        [10, 30, 60, 70], [110, 130, 160, 170], [3.0, 0.0, 0.0, 0.0], [60, 40, 40, 40]
    )
    assert contradicted.tolist() == [False] * 4
    assert supported.tolist() == [False, True, True, True]


def queries(p, way, inliers, *, far_own=None, mission=None):
    count = len(p)
    T = se3.identity(count)
    T[:, 4:] = p
    query = np.array([7, 7, 8][:count])
    mission = np.zeros(count, dtype=np.int64) if mission is None else np.asarray(mission)
    way = np.asarray(way, dtype=float)
    judgement = SimpleNamespace(
        vi_map=SimpleNamespace(missions=range(2)),
        query=query,
        T_M_I=T,
        missions=(mission, mission),
        way_m=(way, way),
        values=SimpleNamespace(inliers=np.asarray(inliers)),
        is_far=np.zeros(count, dtype=bool) if far_own is None else np.asarray(far_own),
        options=LoopClosureOptions(max_drift_ratio=0.1),
    )
    shares = rival_shares(judgement, np.ones(count, dtype=bool))
    return np.unique(query[shares >= 0.5]).tolist()


def test_two_far_places_of_one_mission_are_ambiguous():
    assert queries([[0, 0, 0], [9, 0, 0], [9, 0, 0]], [0, 20, 20], [50, 40, 40]) == [7]


def test_a_much_weaker_second_place_does_not_count():
    assert queries([[0, 0, 0], [9, 0, 0], [9, 0, 0]], [0, 20, 20], [50, 20, 40]) == []


def test_two_ends_of_a_drifting_loop_are_one_place():
    assert queries([[0, 0, 0], [1, 0, 0], [1, 0, 0]], [0, 60, 60], [50, 50, 50]) == []


def test_places_of_two_missions_say_nothing_about_each_other():
    assert queries([[0, 0, 0], [9, 0, 0]], [0, 20], [50, 50], mission=[0, 1]) == []


def test_a_far_place_of_the_own_mission_is_ambiguous():
    assert queries([[0, 0, 0]], [0], [30], far_own=[True]) == [7]
    assert queries([[0, 0, 0]], [0], [15], far_own=[True]) == []


# mission 0 was in a room, mission 1 in its twin, mission 2 in both, which are 9 m apart
TWINS = [
    Walk(room=1),
    Walk(room=1, mission=1, room_at=(0.0, 9.0, 0.0)),
    Walk(room=1, mission=2),
    Walk(room=1, mission=2, start_s=40.0, room_at=(0.0, 9.0, 0.0)),
]


def test_missions_in_rooms_that_look_alike_stay_unknown_with_the_reason():
    vi_map, _ = make_map(TWINS)
    for known in range(3):
        is_known = np.arange(3) == known
        one = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=is_known))
        anchored, report = anchor_missions(one)
        assert anchored.baseframes.is_known.tolist() == is_known.tolist()
        assert report.anchored == ()
        assert "look" in report.failure


def test_known_base_frames_tell_twins_apart():
    vi_map, truth = make_map(TWINS)
    merged, report = close_loops(vi_map)
    assert report.landmarks_merged > 100
    # landmarks of the two rooms stay apart: no landmark is seen from both
    side = truth[merged.keypoint_vertex[merged.observations], 5] > 4.5
    landmark = merged.keypoints.landmark[merged.observations]
    for row in np.unique(landmark):
        assert len(np.unique(side[landmark == row])) == 1


OPTIONS = LoopClosureOptions()
FLOOR = np.diag(np.array([0.01, 0.01, 0.01, 0.002, 0.002, 0.002]) ** 2)


@cache
def accepted() -> Closures:
    walks = [Walk(room=1, vertices=6), Walk(room=1, vertices=6, start_s=60.0)]
    closures = search_loops(make_map(walks)[0])[0].closures
    return closures.take(np.flatnonzero(closures.accepted))


def with_covariance(covariance: np.ndarray) -> Closures:
    count = len(accepted())
    return dataclasses.replace(accepted(), covariance=np.tile(covariance, (count, 1, 1)))


def test_no_edge_is_more_certain_than_points_of_a_map_are() -> None:
    edges = closure_edges(with_covariance(1e-12 * np.eye(6)), OPTIONS)
    np.testing.assert_allclose(edges.covariance, np.tile(FLOOR, (len(edges), 1, 1)), atol=1e-9)


def test_a_closure_that_was_found_twice_gives_one_edge() -> None:
    rows = np.arange(len(accepted()))
    once = closure_edges(accepted(), OPTIONS)
    twice = closure_edges(accepted().take(np.concatenate([rows, rows[:3]])), OPTIONS)
    np.testing.assert_array_equal(twice.id, once.id)
    assert len(np.unique(once.id, axis=0)) == len(once)


def test_covariances_are_those_of_the_relative_pose() -> None:
    # T_A_B = T_M_A^-1 T_M_B, derived by differences of T_M_A
    spread = np.random.default_rng(4).normal(size=(6, 6))
    covariance = 1e-2 * spread @ spread.T
    closures = with_covariance(covariance)
    edges = closure_edges(closures, OPTIONS)
    rows = np.array([closures.id.tolist().index(one) for one in edges.id.tolist()])
    T_M_A, T_A_B = closures.T_M_I[rows], closures.T_A_B[rows]
    T_M_B = se3.compose(T_M_A, T_A_B)
    step = 1e-6
    J = np.empty((len(edges), 6, 6))
    for axis in range(6):
        delta = np.tile(step * np.eye(6)[axis], (len(edges), 1))
        sides = [
            se3.local(T_A_B, se3.relative(se3.retract(T_M_A, sign * delta), T_M_B))
            for sign in (1.0, -1.0)
        ]
        J[:, :, axis] = (sides[0] - sides[1]) / (2.0 * step)
    expected = J @ covariance @ np.swapaxes(J, 1, 2) + FLOOR
    np.testing.assert_allclose(edges.covariance, expected, rtol=1e-5, atol=1e-7)


def test_keypoints_of_one_vertex_are_one_vote() -> None:
    source, target = np.array([3, 3, 9, 9]), np.array([7, 7, 4, 4])
    bits = np.array([10, 20, 1, 3], dtype=np.int32)
    votes = Votes(source, target, np.array([5, 5, 5, 6]), bits, bits == 1)
    pairs = count_pairs(votes, np.arange(20))
    rows = zip(pairs.first.tolist(), pairs.second.tolist(), pairs.votes.tolist(), strict=True)
    assert sorted(rows) == [(7, 3, 1), (9, 4, 2)]
    assert pairs.bits[pairs.of_vote].tolist() == [15.0, 15.0, 2.0, 2.0]
    assert pairs.is_doubtful[pairs.of_vote].tolist() == [False, False, True, True]


def test_places_seen_too_recently_are_not_searched() -> None:
    # many landmarks of the latest walks must not take the place of the first's, the single neighbour
    latest = [Walk(room=1, vertices=4, start_s=60.0 + 2.5 * row) for row in range(16)]
    vi_map = make_map([Walk(room=1, vertices=2), *latest])[0]
    for seconds, count in ((50.0, 64), (120.0, 0)):
        options = LoopClosureOptions(min_image_time_seconds=seconds, num_neighbors=1)
        closures = search_loops(vi_map, options)[0].closures
        latest_queries = closures.query_vertex[closures.accepted & (closures.query_vertex >= 2)]
        assert len(np.unique(latest_queries)) == count
