from __future__ import annotations

import itertools

import numpy as np
import pytest

from maplab_py.algorithms.anchoring.options import AnchoringOptions
from maplab_py.algorithms.anchoring.pairs import (
    USED,
    Sightings,
    align_pairs,
    consistent,
    fit_missions,
    strongest_pairs,
)
from maplab_py.geometry import yaw

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
    return Sightings(
        np.array(A), np.array(B), np.concatenate(T_A_I), np.concatenate(T_B_I),
        np.full(len(A), 30.0),
    )  # fmt: skip


def verdicts(counts, wrong=()):
    pairs = consistent(align_pairs(sightings(counts, wrong), {}, OPTIONS), OPTIONS, list("wxyz"))
    return {(p.a, p.b): p.verdict for p in pairs}


def test_alignments_are_where_the_missions_are():
    pairs = align_pairs(sightings({(0, 1): 20, (1, 2): 20}), {}, OPTIONS)
    for p in pairs:
        expected = yaw.compose(yaw.inverse(PLACES[p.b]), PLACES[p.a])
        np.testing.assert_allclose(p.T_B_A, expected, atol=0.06)
        assert p.verdict == USED
        assert 0.02 < p.rms_m < 0.15


def test_right_triangles_stay():
    every = dict.fromkeys(itertools.combinations(range(4), 2), 20)
    assert set(verdicts(every).values()) == {USED}


@pytest.mark.parametrize("bad", list(itertools.combinations(range(4), 2)))
def test_one_wrong_pair_among_four_missions_is_found_even_when_it_is_the_strongest(bad):
    counts = {pair: 60 if pair == bad else 20 for pair in itertools.combinations(range(4), 2)}
    found = verdicts(counts, wrong=[bad])
    assert "contradicts the others" in found.pop(bad)
    assert set(found.values()) == {USED}


def test_three_missions_that_contradict_leave_only_what_is_clearly_stronger():
    equal = verdicts({(0, 1): 20, (1, 2): 20, (0, 2): 18}, wrong=[(0, 2)])
    assert USED not in equal.values()
    strong = verdicts({(0, 1): 50, (1, 2): 50, (0, 2): 10}, wrong=[(0, 2)])
    assert strong[0, 1] == strong[1, 2] == USED
    assert "contradicts the others among w, x, y" in strong[0, 2]


def test_pairs_that_only_look_alike_are_named():
    undecided = {(2, 3): "17 places that look alike"}
    pairs = align_pairs(sightings({(0, 1): 20}), undecided, OPTIONS)
    verdict = {(p.a, p.b): p.verdict for p in pairs}
    assert verdict[0, 1] == USED
    assert verdict[2, 3] == "17 places that look alike"


def test_too_few_or_too_divided_closures_are_no_alignment():
    few = align_pairs(sightings({(0, 1): 3}), {}, OPTIONS)
    assert few[0].verdict == "3 closures agree, 4 are needed"
    T = sightings({(0, 1): 30})
    moved = T.T_B_I.copy()
    moved[::2, 4:] += np.random.default_rng(1).uniform(5, 50, (15, 3))
    moved[::3, 4:] -= np.random.default_rng(2).uniform(5, 50, (10, 3))
    divided = Sightings(T.mission_A, T.mission_B, T.T_A_I, moved, T.weight)
    assert "closures agree" in align_pairs(divided, {}, OPTIONS)[0].verdict


def test_few_missions_keep_all_their_pairs():
    every = dict.fromkeys(itertools.combinations(range(4), 2), 20)
    assert strongest_pairs(sightings(every), 4) == set(every)


def test_of_many_missions_each_keeps_its_strongest_pairs_and_none_is_cut_off():
    # 30 missions that all see each other, and a chain of three that hangs on by weak pairs
    count = 30
    pairs = list(itertools.combinations(range(count), 2))
    chain = [(count - 1, count), (count, count + 1), (count + 1, count + 2)]
    A, B = np.array(pairs + chain).T
    weight = np.append(np.random.default_rng(0).uniform(10.0, 50.0, len(pairs)), [1.0, 1.0, 1.0])
    T = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(A), 1))
    chosen = strongest_pairs(Sightings(A, B, T, T, weight), count + 3)
    assert set(chain) <= chosen
    assert 10 * count / 2 <= len(chosen) <= 10 * count + 3
    strongest = max(range(len(pairs)), key=lambda i: weight[i])
    assert pairs[strongest] in chosen


def test_the_joint_fit_is_a_minimum():
    T = sightings({(0, 1): 30, (1, 2): 30, (0, 2): 10}, wrong=[(0, 2)])
    fixed = np.array([True, False, False, True])
    fitted = fit_missions(T, PLACES + 0.05, fixed)
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
