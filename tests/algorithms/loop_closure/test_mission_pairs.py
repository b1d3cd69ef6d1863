from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.mission_pairs import (
    PairedClosures,
    PairRule,
    without_alignment,
)
from maplab_py.geometry import se3, yaw

RULE = PairRule(drift_offset_m=0.5, drift_ratio=0.1, max_share=0.25)


def closures(alignments, *, seed=0, mission=(0, 1), noise_m=0.05):
    """Return closures whose queries walk a line; each tells the given T_B_A (N, 4)."""
    rng = np.random.default_rng(seed)
    T_B_A = np.asarray(alignments, dtype=float)
    count = len(T_B_A)
    way = np.linspace(0.0, 10.0, count)
    p_A = np.stack([way, np.sin(way), np.zeros(count)], axis=1)
    T_A_I = se3.make(yaw.quaternion(0.1 * way), p_A)
    T_B_I = se3.compose(yaw.to_pose(T_B_A), T_A_I)
    T_B_I[:, 4:] += rng.normal(scale=noise_m, size=(count, 3))
    ends = tuple(np.full(count, m) for m in mission)
    return PairedClosures.of(ends, (T_A_I, T_B_I), (way, way), np.full(count, 40.0))


def refused(c, looks_alike=0):
    count = len(c.weight)
    alike = np.arange(count) < looks_alike
    return without_alignment(c, ~alike, alike, RULE)[looks_alike:]


HERE, THERE = [1.0, 2.0, 0.0, 0.4], [10.0, 2.0, 0.0, 0.4]


def test_closures_of_one_alignment_stay():
    assert not refused(closures([HERE] * 40)).any()


def test_a_few_that_contradict_are_refused_alone():
    result = refused(closures([HERE] * 36 + [THERE] * 4))
    assert result.tolist() == [False] * 36 + [True] * 4


@pytest.mark.parametrize("rivals", [12, 20])
def test_two_alignments_with_a_following_refuse_each_other(rivals):
    assert refused(closures([HERE] * (40 - rivals) + [THERE] * rivals)).all()


def test_many_queries_that_fit_several_places_refuse_the_whole_pair():
    assert not refused(closures([HERE] * 50), looks_alike=9).any()
    assert refused(closures([HERE] * 50), looks_alike=20).all()


def test_drift_along_the_way_is_no_contradiction():
    bent = np.array([HERE] * 40)
    bent[:, 0] += np.linspace(0.0, 1.2, 40)
    assert not refused(closures(bent)).any()


def test_direction_of_the_search_does_not_matter():
    one = closures([HERE] * 30 + [THERE] * 3)
    other = closures([HERE] * 30 + [THERE] * 3, mission=(1, 0))
    assert other.mission_A.tolist() == one.mission_A.tolist()
    np.testing.assert_array_equal(other.T_A_I, one.T_B_I)
    assert refused(other).tolist() == refused(one).tolist()


def test_pairs_are_judged_one_by_one():
    good, bad = closures([HERE] * 20), closures([HERE] * 10 + [THERE] * 10, mission=(0, 2))
    both = PairedClosures(
        *(
            np.concatenate([getattr(good, field.name), getattr(bad, field.name)])
            for field in dataclasses.fields(PairedClosures)
        )
    )
    assert refused(both).tolist() == [False] * 20 + [True] * 20
