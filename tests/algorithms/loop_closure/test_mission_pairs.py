"""Alignments between two missions and over many, and when one of them wins."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure import candidates, detection, matching
from maplab_py.algorithms.loop_closure import features as features_module
from maplab_py.algorithms.loop_closure.ambiguity import (
    AlignmentChoice,
    decide,
    listed_alignments,
    with_choice,
)
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.loop_closure.matching import SearchMemory, match_features
from maplab_py.algorithms.loop_closure.mission_alignment import (
    LocatedClosures,
    alignments_of_pairs,
    ordered_by_mission,
)
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.errors import UserError
from maplab_py.geometry import se3, yaw
from maplab_py.vimap import BaseFrames, Missions, Vertices, VIMap
from maplab_py.vimap.ids import random_ids
from maplab_py.vision.index import MatchRule
from tests.algorithms.anchoring.test_anchoring import scrambled
from tests.algorithms.loop_closure.rooms import Walk, make_map

MAX_SHARE = 0.1
LENGTH_M = 60.0
HERE, THERE = [1.0, 2.0, 0.0, 0.4], [21.0, 2.0, 0.0, 0.4]  # 20 m apart in frame B


def lines(missions: int) -> VIMap:
    """Return missions that walk a line of 60 m."""
    rng = np.random.default_rng(0)
    p = np.stack([np.arange(LENGTH_M), np.zeros(60), np.zeros(60)], axis=1)
    T_M_I = np.tile(se3.make(so3_identity(60), p), (missions, 1))
    return VIMap(
        missions=Missions.filled(
            missions,
            id=random_ids(missions, rng),
            baseframe=np.arange(missions),
            root_vertex=60 * np.arange(missions),
        ),
        baseframes=BaseFrames.filled(missions, id=random_ids(missions, rng)),
        vertices=Vertices.filled(
            60 * missions,
            id=random_ids(60 * missions, rng),
            mission=np.repeat(np.arange(missions), 60),
            T_M_I=T_M_I,
            timestamp_ns=np.tile(np.arange(60) * 10**9, missions),
        ),
    )


def so3_identity(count: int) -> np.ndarray:
    return np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))


def closures(way_m, alignment, *, mission=(0, 1), noise_m=0.05, drift=0.0) -> LocatedClosures:
    """Return closures of queries that walk frame A's x axis; each tells the given T_B_A."""
    way = np.asarray(way_m, dtype=float)
    rng = np.random.default_rng(len(way))
    T_B_A = np.tile(np.asarray(alignment, dtype=float), (len(way), 1))
    T_B_A[:, 1] += drift * way
    T_A_I = se3.make(so3_identity(len(way)), np.stack([way, 0 * way, 0 * way], axis=1))
    T_B_I = se3.compose(yaw.to_pose(T_B_A), T_A_I)
    way_B = T_B_I[:, 4] / np.cos(0.4)
    T_B_I[:, 4:] += rng.normal(scale=noise_m, size=(len(way), 3))
    stretch = tuple(
        (100 * m + np.floor(w)).astype(np.int64) for m, w in zip(mission, (way, way_B), strict=True)
    )
    ends = tuple(np.full(len(way), m) for m in mission)
    columns = ordered_by_mission(ends, (T_A_I, T_B_I), (way, way_B), stretch)
    return LocatedClosures(np.full(len(way), 40.0), *columns)


def join(*parts: LocatedClosures) -> LocatedClosures:
    return LocatedClosures.concatenate(parts)


def contests(c: LocatedClosures, missions: int = 2):
    vi_map = lines(missions)
    pairs = alignments_of_pairs(c, np.ones(len(c.weight), dtype=bool))
    stretch = np.concatenate([100 * m + np.arange(60) for m in range(missions)])
    return decide(vi_map, pairs, stretch, MAX_SHARE, [f"m{i}" for i in range(missions)])


def metres(begin: float, end: float) -> np.ndarray:
    return np.arange(begin, end, 0.5)


def test_closures_of_one_alignment_win():
    (contest,) = contests(closures(metres(0, 20), HERE))
    assert contest.winner == 0
    np.testing.assert_allclose(contest.pair.alignments[0].T_B_A, HERE, atol=0.2)
    assert contest.accepted.tolist() == list(range(40))


def test_a_few_that_contradict_are_refused_alone():
    (contest,) = contests(join(closures(metres(0, 30), HERE), closures([3.0, 3.5, 3.9], THERE)))
    assert contest.winner == 0
    assert contest.accepted.tolist() == list(range(60))


def test_the_alignment_that_explains_both_rooms_wins_against_those_that_exchange_them():
    # rooms at 0 to 15 and 20 to 35 m, a corridor between; closures of each room with the other too
    truth = closures(metres(0, 35), HERE)
    forth = closures(metres(0, 15), THERE)
    back = closures(metres(20, 35), (yaw.compose(HERE, [-20.0, 0, 0, 0])))
    (contest,) = contests(join(truth, forth, back))
    assert contest.winner == 0
    assert contest.accepted.tolist() == list(range(70))
    assert len(contest.pair.alignments) == 3


def test_a_mission_of_one_room_is_not_aligned_with_one_of_both():
    # mission 0 was in one room, mission 1 in both: its queries fit the two equally well
    both = join(closures(metres(0, 15), HERE), closures(metres(0, 15), THERE))
    (contest,) = contests(both)
    assert contest.winner == -1
    assert "look like other places" in contest.reason
    assert len(contest.accepted) == 0


@pytest.mark.parametrize("share", [0.3, 0.7])
def test_time_spent_in_either_room_is_no_evidence(share):
    rows = metres(0, 15)
    part = closures(rows[: round(share * len(rows))], THERE)
    (contest,) = contests(join(closures(rows, HERE), part))
    assert contest.winner == -1


def test_a_third_mission_reveals_that_places_look_alike():
    # 0 and 1 agree on one alignment, but 2 saw two rooms that 0 cannot distinguish
    pair = closures(metres(0, 15), HERE)
    third = [closures(metres(0, 15), to, mission=(0, 2)) for to in (HERE, THERE)]
    first, second = contests(join(pair, *third), missions=3)
    assert first.winner == second.winner == -1
    assert "mission m2 shows" in first.reason


def test_drift_along_the_way_is_no_contradiction():
    (contest,) = contests(closures(metres(0, 40), HERE, drift=0.055))
    assert len(contest.accepted) == 80


def test_direction_of_the_search_does_not_matter():
    forth = closures(metres(0, 20), HERE)
    forwards = (
        (forth.mission_A, forth.mission_B),
        (forth.T_A_I, forth.T_B_I),
        (forth.way_A_m, forth.way_B_m),
    )
    back = ordered_by_mission(*(ends[::-1] for ends in forwards))
    for ordered, column in zip(back, (each for ends in forwards for each in ends), strict=True):
        np.testing.assert_array_equal(ordered, column)


def test_pairs_are_judged_one_by_one():
    bad = [closures(metres(0, 15), to, mission=(0, 2)) for to in (HERE, THERE)]
    good = closures(metres(30, 50), HERE)
    assert [c.winner for c in contests(join(good, *bad), missions=3)] == [0, -1]


def test_the_order_of_the_closures_does_not_matter():
    c = join(closures(metres(0, 30), HERE), closures(metres(0, 15), THERE))
    order = np.random.default_rng(3).permutation(len(c.weight))
    (one,), (other,) = contests(c), contests(c.take(order))
    assert one.winner == other.winner
    assert [a.support for a in one.pair.alignments] == [a.support for a in other.pair.alignments]


def test_a_person_decides_by_number_or_by_pose():
    undecided = contests(join(closures(metres(0, 15), HERE), closures(metres(0, 15), THERE)))
    assert listed_alignments(undecided) == [(0, 0), (0, 1)]
    for number in (1, 2):
        (chosen,) = with_choice(undecided, AlignmentChoice(number))
        assert chosen.winner == number - 1
        assert len(chosen.accepted) == 30
    near = AlignmentChoice(missions=(0, 1), T_B_A=np.array([20.0, 2.5, 0.0, 0.3]))
    (chosen,) = with_choice(undecided, near)
    np.testing.assert_allclose(chosen.pair.alignments[chosen.winner].T_B_A, THERE, atol=0.2)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (AlignmentChoice(3), "--anchor_hypothesis=3: the alignments are from 1 to 2"),
        (AlignmentChoice(-1), "--anchor_hypothesis=-1"),
        (AlignmentChoice(missions=(0, 1), T_B_A=np.array([8.0, 2, 0, 0.4])), "the nearest is [67]"),
        (AlignmentChoice(missions=(1, 2)), "no verified closure joins"),
    ],
)
def test_an_impossible_choice_is_refused(choice, message):
    undecided = contests(join(closures(metres(0, 15), HERE), closures(metres(0, 15), THERE)))
    with pytest.raises(UserError, match=message):
        with_choice(undecided, choice)


def test_a_choice_without_doubt_is_refused():
    with pytest.raises(UserError, match="no alignment is in doubt"):
        with_choice(contests(closures(metres(0, 20), HERE)), AlignmentChoice(1))


def test_closures_that_contain_no_number_support_nothing():
    c = closures(metres(0, 20), HERE)
    c.T_B_I[5] = np.nan
    (contest,) = contests(c)
    assert contest.winner == 0
    assert 5 not in contest.accepted


LIMITED = LoopClosureOptions(max_missions_per_query=2)
WALKS = [Walk(room=1, mission=m, vertices=6) for m in range(6)]
MATCH_RULE = MatchRule(10 * 10**9)


@pytest.fixture(scope="module")
def room():
    vi_map = make_map(WALKS)[0]
    return vi_map, map_features(vi_map, np.arange(6))[0]


def missions_per_query(features, matches):
    session = features.descriptors.session
    key = np.stack([features.vertex[matches.query], session[matches.database]], axis=1)
    other = session[matches.query] != session[matches.database]
    vertex = np.unique(key[other], axis=0)[:, 0]
    return np.unique(vertex, return_counts=True)[1]


def test_a_query_is_compared_with_few_missions(room):
    _, features = room
    matches, landmarks = match_features(features, LIMITED, MATCH_RULE, apart=True)
    assert missions_per_query(features, matches).max() == 2
    everywhere, same = match_features(features, LoopClosureOptions(), MATCH_RULE, apart=True)
    assert missions_per_query(features, everywhere).max() == 5
    assert landmarks == same
    assert np.all(np.diff(matches.query) >= 0)


def test_few_missions_get_more_matches_each(room):
    _, features = room
    counts = []
    for options in (LIMITED, LoopClosureOptions()):
        matches, _ = match_features(features, options, MATCH_RULE, apart=True)
        pairs = np.count_nonzero(
            features.descriptors.session[matches.query]
            != features.descriptors.session[matches.database]
        )
        counts.append(pairs / missions_per_query(features, matches).sum())
    assert counts[0] > 1.3 * counts[1]


def test_all_missions_are_anchored_although_each_query_sees_two():
    anchored, report = anchor_missions(scrambled(WALKS, known=[3], seed=1), loop_options=LIMITED)
    assert report.failure == ""
    assert len(report.anchored) == 5
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 0.05


def test_a_repeated_search_of_chosen_missions_builds_no_index(room, monkeypatch):
    _, features = room
    monkeypatch.setattr(matching, "MEMORY", SearchMemory())
    first, _ = match_features(features, LIMITED, MATCH_RULE, apart=True)
    monkeypatch.delattr(matching, "InvertedMultiIndex")
    again, _ = match_features(
        features, LIMITED, MATCH_RULE, apart=False
    )  # both are searched anyway
    np.testing.assert_array_equal(first.database, again.database)
    half = np.arange(len(features)) % 2 == 0
    changed = dataclasses.replace(features, in_database=features.in_database & half)
    with pytest.raises(NameError):
        match_features(changed, LIMITED, MATCH_RULE, apart=True)
    with pytest.raises(NameError):
        match_features(features, dataclasses.replace(LIMITED, seed=1), MATCH_RULE, apart=True)


@pytest.mark.parametrize(
    ("module", "name", "size"),
    [
        (features_module, "_RAYS_AT_ONCE", 1000),
        (candidates, "_PART_BYTES", 1e5),
        (detection, "_MATCHES_AT_ONCE", 500),
    ],
)
def test_places_that_are_looked_at_in_parts_are_the_same(room, monkeypatch, module, name, size):
    whole = search_loops(room[0])[0].closures
    monkeypatch.setattr(module, name, size)
    parts = search_loops(room[0])[0].closures
    assert len(whole) > 50
    for field in dataclasses.fields(whole):
        np.testing.assert_array_equal(getattr(whole, field.name), getattr(parts, field.name))
