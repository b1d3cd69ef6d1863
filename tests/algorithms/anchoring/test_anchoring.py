"""Base frames of missions: from pairs, over trees of missions, against rooms that look alike."""

import dataclasses
import itertools

import numpy as np
import pytest

from maplab_py.algorithms.anchoring import pairs as anchor_pairs
from maplab_py.algorithms.anchoring.absolute import AbsoluteAnchoringOptions
from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.loop_closure.mission_alignment import PairedClosures
from maplab_py.geometry import se3, so3, yaw
from maplab_py.vimap import AbsolutePoses, to_hex
from tests.algorithms.loop_closure.rooms import Walk, make_map


def scrambled(walks, *, known, seed):
    """Return a map whose base frames are at random places but for the known ones."""
    vi_map, _ = make_map(walks)
    rng = np.random.default_rng(seed)
    count = len(vi_map.missions)
    moved = np.concatenate([rng.uniform(-10, 10, (count, 3)), rng.uniform(-3, 3, (count, 1))], 1)
    is_known = np.isin(np.arange(count), known)
    T_G_M = np.where(is_known[:, None], se3.identity(count), yaw.to_pose(moved))
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M, is_known=is_known))


THREE = [Walk(room=1), Walk(room=1, mission=1), Walk(room=1, mission=2)]


@pytest.mark.parametrize("known", [0, 1, 2])
def test_all_missions_find_their_place_from_any_known_one(known):
    anchored, report = anchor_missions(scrambled(THREE, known=[known], seed=known))
    assert report.failure == ""
    assert len(report.anchored) == 2
    assert anchored.baseframes.is_known.all()
    error = yaw.from_pose(anchored.T_G_M)
    assert np.abs(error[:, :3]).max() < 0.03
    assert np.degrees(np.abs(error[:, 3]).max()) < 0.3


def test_only_base_frames_of_anchored_missions_change():
    vi_map = scrambled(THREE, known=[0], seed=4)
    anchored, _ = anchor_missions(vi_map)
    assert anchored.vertices is vi_map.vertices
    assert anchored.landmarks is vi_map.landmarks
    np.testing.assert_array_equal(anchored.T_G_M[0], vi_map.T_G_M[0])


def test_a_mission_of_another_place_stays_unknown_with_a_reason():
    vi_map = scrambled([*THREE, Walk(room=9, mission=3)], known=[0], seed=5)
    anchored, report = anchor_missions(vi_map)
    assert anchored.baseframes.is_known.tolist() == [True, True, True, False]
    np.testing.assert_array_equal(anchored.T_G_M[3], vi_map.T_G_M[3])
    assert len(report.not_anchored) == 1
    assert "no verified closure" in report.failure


def test_a_chain_of_missions_is_followed():
    # 0 and 2 have no room in common, 1 was in both
    walks = [
        Walk(room=1),
        Walk(room=1, mission=1),
        Walk(room=2, mission=1, start_s=30.0, room_at=(0.0, 8.0, 0.0)),
        Walk(room=2, mission=2, room_at=(0.0, 8.0, 0.0)),
    ]
    anchored, report = anchor_missions(scrambled(walks, known=[0], seed=6))
    assert report.failure == ""
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 0.1


def test_one_mission_alone_leaves_the_others():
    vi_map = scrambled(THREE, known=[0], seed=7)
    anchored, report = anchor_missions(vi_map, missions=np.array([2]))
    assert anchored.baseframes.is_known.tolist() == [True, False, True]
    assert len(report.anchored) == 1


def test_without_a_known_mission_the_remedy_is_named():
    _, report = anchor_missions(scrambled(THREE, known=[], seed=8))
    assert "set_mission_baseframe_to_known" in report.failure


def test_nothing_to_anchor_is_no_failure():
    vi_map, _ = make_map(THREE)
    same, report = anchor_missions(vi_map)
    assert same is vi_map
    assert report.failure == ""
    assert "known already" in report.notes[0]


def with_markers(vi_map, mission, *, wrong=0, sigma_rad=0.01):
    """Return the map with an absolute pose at every vertex of a mission, some of them 20 m off."""
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    T_G_S = np.array(vi_map.vertices.T_M_I[rows])  # missions are drawn where G is
    T_G_S[:wrong, 4:] += 20.0
    sigma = np.array([0.05, 0.05, 0.05, *[sigma_rad] * 3])
    poses = AbsolutePoses.filled(
        len(rows),
        vertex=rows,
        timestamp_ns=vi_map.vertices.timestamp_ns[rows],
        T_G_S=T_G_S,
        covariance=np.tile(np.diag(sigma**2), (len(rows), 1, 1)),
    )
    return vi_map.replace(absolute_poses=poses)


def test_missions_with_absolute_poses_come_first():
    vi_map = with_markers(scrambled(THREE, known=[], seed=10), 1, wrong=3)
    anchored, report = anchor_missions(vi_map)
    assert report.failure == ""
    assert report.by_absolute_poses == report.anchored[:1] == (to_hex(vi_map.missions.id[1])[:8],)
    assert anchored.baseframes.is_known.all()
    error = yaw.from_pose(anchored.T_G_M)
    assert np.abs(error[1]).max() < 5e-3
    assert np.abs(error[:, :3]).max() < 0.03
    # a known mission elsewhere does not hinder it, and stays where it is
    vi_map = with_markers(scrambled(THREE[:2], known=[0], seed=11), 1)
    anchored, report = anchor_missions(vi_map, missions=np.array([1]))
    assert len(report.already_known) == 1
    np.testing.assert_array_equal(anchored.T_G_M[0], vi_map.T_G_M[0])


def test_absolute_poses_that_disagree_anchor_nothing():
    few = AbsoluteAnchoringOptions(min_number_of_constraints=13)
    turned = with_markers(scrambled(THREE[:1], known=[], seed=12), 0)
    q = so3.multiply(so3.exp([0.0, 0.0, 0.5]), turned.absolute_poses.T_G_S[:, :4])
    T_G_S = se3.make(q, turned.absolute_poses.T_G_S[:, 4:])
    turned = turned.replace(absolute_poses=turned.absolute_poses.replace(T_G_S=T_G_S))
    for vi_map, options, message in (
        (
            with_markers(scrambled(THREE[:1], known=[], seed=12), 0),
            few,
            "min_number_of_constraints=13",
        ),
        (turned, AbsoluteAnchoringOptions(), "0 of 12 absolute poses agree"),
    ):
        same, report = anchor_missions(vi_map, absolute=options)
        assert same is vi_map
        assert message in report.notes[0]
        assert "set_mission_baseframe_to_known" in report.failure
    # orientations that were not measured do not count
    loose = turned.absolute_poses.replace(
        covariance=np.tile(np.diag([0.01] * 3 + [1e6] * 3), (12, 1, 1))
    )
    anchored, report = anchor_missions(turned.replace(absolute_poses=loose))
    assert len(report.by_absolute_poses) == 1
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 1e-3


def test_missions_that_are_anchored_need_not_anchor_others():
    walks = [
        Walk(room=1),
        Walk(room=1, mission=1),
        Walk(room=2, mission=1, start_s=30.0, room_at=(0.0, 8.0, 0.0)),
        Walk(room=2, mission=2, room_at=(0.0, 8.0, 0.0)),
    ]
    vi_map = scrambled(walks, known=[0], seed=6)
    anchored, report = anchor_missions(vi_map, AnchoringOptions(add_to_database=False))
    assert anchored.baseframes.is_known.tolist() == [True, True, False]
    assert len(report.not_anchored) == 1


def test_order_of_missions_does_not_matter():
    for order in ([0, 1, 2], [2, 1, 0]):
        walks = [Walk(room=1, mission=m, drift=(0.3 * m, 0.0, 0.0, 0.1 * m)) for m in order]
        walks.sort(key=lambda walk: walk.mission)
        anchored, _ = anchor_missions(scrambled(walks, known=[0], seed=9))
        expected = yaw.inverse(np.array([[0.3 * m, 0.0, 0.0, 0.1 * m] for m in range(3)]))
        np.testing.assert_allclose(yaw.from_pose(anchored.T_G_M), expected, atol=0.03)


HERE, THERE = (0.0, 48.0, 0.0), (0.0, 75.0, 0.0)
"""Where two rooms are that look alike."""


def visits(room: int, missions: list[int], *, vertices: int = 8) -> list[Walk]:
    """Return walks of some missions through one room, which no other room is near."""
    place, start_s = (0.0, 12.0 * room, 0.0), 60.0 * room
    return [Walk(room, m, start_s, vertices, room_at=place) for m in missions]


def aliased(first: int, second: int, *, vertices: int) -> list[Walk]:
    """Return walks of two missions through two rooms that look alike."""
    return [
        Walk(9, m, 900.0, vertices, room_at=place) for m, place in ((first, HERE), (second, THERE))
    ]


def anchored(walks: list[Walk]) -> tuple[np.ndarray, dict[tuple[int, int], str]]:
    """Anchor to mission 0; return the errors of the base frames and the verdicts on the pairs."""
    walks = sorted(walks, key=lambda walk: (walk.mission, walk.start_s))
    result, report = anchor_missions(scrambled(walks, known=[0], seed=1))
    assert report.not_anchored == {}
    names = {name: row for row, name in enumerate((*report.already_known, *report.anchored))}
    verdicts = {}
    for one in report.alignments:
        a, b = (names[name] for name in one.missions.split(" - "))
        verdicts[a, b] = one.verdict
    return yaw.from_pose(result.T_G_M), verdicts


def test_the_strongest_pair_is_refused_when_going_round_does_not_lead_back():
    walks = visits(1, [0, 2, 3]) + visits(2, [1, 2, 3]) + aliased(0, 1, vertices=20)
    error, verdicts = anchored(walks)
    assert np.abs(error).max() < 0.1
    assert "contradicts the others among" in verdicts.pop((0, 1))
    assert set(verdicts.values()) == {"used"}


def test_missions_are_placed_by_the_strongest_pairs():
    # a cycle of four has no triangle to check; the weakest of its pairs is wrong
    walks = visits(1, [0, 1]) + visits(2, [1, 2]) + visits(3, [2, 3]) + aliased(0, 3, vertices=6)
    error, verdicts = anchored(walks)
    assert np.abs(error).max() < 0.1
    assert verdicts.pop((0, 3)) == "contradicts stronger alignments"
    assert set(verdicts.values()) == {"used"}


OPTIONS = AnchoringOptions()
PLACES = np.array([[0.0, 0, 0, 0], [3, 1, 0, 0.5], [-2, 4, 1, -1.0], [5, -3, 0.5, 2.0]])  # T_G_M


def sightings(counts, wrong=(), seed=0):
    """Return closures between missions at PLACES; those of wrong pairs are shifted by a room."""
    rng = np.random.default_rng(seed)
    A, B, T_A_I, T_B_I = [], [], [], []
    for (a, b), count in counts.items():
        T_G_I = np.column_stack([rng.uniform(-4, 4, (count, 3)), rng.uniform(-3, 3, count)])
        own = yaw.compose(yaw.inverse(PLACES[a]), T_G_I)
        other = yaw.compose(yaw.inverse(PLACES[b]), T_G_I)
        other[:, :3] += rng.normal(scale=0.05, size=(count, 3))
        if (a, b) in wrong:
            other[:, 0] += 9.0
        A += [a] * count
        B += [b] * count
        T_A_I.append(yaw.to_pose(own))
        T_B_I.append(yaw.to_pose(other))
    return PairedClosures(
        np.full(len(A), 30.0), np.array(A), np.array(B), np.concatenate(T_A_I),
        np.concatenate(T_B_I),
    )  # fmt: skip


def verdicts(counts, wrong=()):
    pairs = anchor_pairs.consistent(
        anchor_pairs.align_pairs(sightings(counts, wrong), {}, OPTIONS), OPTIONS, list("wxyz")
    )
    return {(p.a, p.b): p.verdict for p in pairs}


def test_alignments_are_where_the_missions_are():
    pairs = anchor_pairs.align_pairs(sightings({(0, 1): 20, (1, 2): 20}), {}, OPTIONS)
    for p in pairs:
        expected = yaw.compose(yaw.inverse(PLACES[p.b]), PLACES[p.a])
        np.testing.assert_allclose(p.T_B_A, expected, atol=0.06)
        assert p.verdict == anchor_pairs.USED
        assert 0.02 < p.rms_m < 0.15


def test_right_triangles_stay():
    every = dict.fromkeys(itertools.combinations(range(4), 2), 20)
    assert set(verdicts(every).values()) == {anchor_pairs.USED}


@pytest.mark.parametrize("bad", list(itertools.combinations(range(4), 2)))
def test_one_wrong_pair_among_four_missions_is_found_even_when_it_is_the_strongest(bad):
    counts = {pair: 60 if pair == bad else 20 for pair in itertools.combinations(range(4), 2)}
    found = verdicts(counts, wrong=[bad])
    assert "contradicts the others" in found.pop(bad)
    assert set(found.values()) == {anchor_pairs.USED}


def test_three_missions_that_contradict_leave_only_what_is_clearly_stronger():
    equal = verdicts({(0, 1): 20, (1, 2): 20, (0, 2): 18}, wrong=[(0, 2)])
    assert anchor_pairs.USED not in equal.values()
    strong = verdicts({(0, 1): 50, (1, 2): 50, (0, 2): 10}, wrong=[(0, 2)])
    assert strong[0, 1] == strong[1, 2] == anchor_pairs.USED
    assert "contradicts the others among w, x, y" in strong[0, 2]


def test_pairs_that_only_look_alike_are_named():
    undecided = {(2, 3): "17 places that look alike"}
    pairs = anchor_pairs.align_pairs(sightings({(0, 1): 20}), undecided, OPTIONS)
    verdict = {(p.a, p.b): p.verdict for p in pairs}
    assert verdict[0, 1] == anchor_pairs.USED
    assert verdict[2, 3] == "17 places that look alike"


def test_too_few_or_too_divided_closures_are_no_alignment():
    few = anchor_pairs.align_pairs(sightings({(0, 1): 3}), {}, OPTIONS)
    assert few[0].verdict == "3 closures agree, 4 are needed"
    T = sightings({(0, 1): 30})
    moved = T.T_B_I.copy()
    moved[::2, 4:] += np.random.default_rng(1).uniform(5, 50, (15, 3))
    moved[::3, 4:] -= np.random.default_rng(2).uniform(5, 50, (10, 3))
    divided = dataclasses.replace(T, T_B_I=moved)
    assert "closures agree" in anchor_pairs.align_pairs(divided, {}, OPTIONS)[0].verdict


def test_few_missions_keep_all_their_pairs():
    every = dict.fromkeys(itertools.combinations(range(4), 2), 20)
    assert anchor_pairs.strongest_pairs(sightings(every), 4) == set(every)


def test_of_many_missions_each_keeps_its_strongest_pairs_and_none_is_cut_off():
    # 30 missions that all see each other, and a chain of three that hangs on by weak pairs
    count = 30
    pairs = list(itertools.combinations(range(count), 2))
    chain = [(count - 1, count), (count, count + 1), (count + 1, count + 2)]
    A, B = np.array(pairs + chain).T
    weight = np.append(np.random.default_rng(0).uniform(10.0, 50.0, len(pairs)), [1.0, 1.0, 1.0])
    T = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(A), 1))
    chosen = anchor_pairs.strongest_pairs(PairedClosures(weight, A, B, T, T), count + 3)
    assert set(chain) <= chosen
    assert 10 * count / 2 <= len(chosen) <= 10 * count + 3
    strongest = max(range(len(pairs)), key=lambda i: weight[i])
    assert pairs[strongest] in chosen


def test_the_joint_fit_is_a_minimum():
    T = sightings({(0, 1): 30, (1, 2): 30, (0, 2): 10}, wrong=[(0, 2)])
    fixed = np.array([True, False, False, True])
    fitted = anchor_pairs.fit_missions(T, PLACES + 0.05, fixed)
    np.testing.assert_array_equal(fitted[fixed], PLACES[fixed] + 0.05)
    lowest = cost(T, fitted)
    for mission, column in itertools.product((1, 2), range(4)):
        for step in (-1e-3, 1e-3):
            moved = fitted.copy()
            moved[mission, column] += step
            assert cost(T, moved) > lowest


def cost(s, T_G_M):
    """Return the robust cost as it is defined, closure by closure."""
    total = 0.0
    for a, b, T_A_I, T_B_I, weight in zip(
        s.mission_A, s.mission_B, s.T_A_I, s.T_B_I, s.weight, strict=True
    ):
        gap = yaw.transform(T_G_M[a], T_A_I[4:]) - yaw.transform(T_G_M[b], T_B_I[4:])
        measured = yaw.from_pose(T_B_I)[3] - yaw.from_pose(T_A_I)[3]
        turn = yaw.wrap(T_G_M[a, 3] - T_G_M[b, 3] - measured)
        whitened = np.append(gap / 0.1, turn / 0.02) * np.sqrt(weight / s.weight.mean())
        total += np.sum(2.0 * (np.sqrt(1.0 + whitened**2) - 1.0))
    return total
