"""Gates and consensus on closures that are made by hand: each refuses for its own reason."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.closure_table import VERDICTS, GateValues
from maplab_py.algorithms.loop_closure.consensus import ConsensusRule, check_consensus
from maplab_py.algorithms.loop_closure.gates import judge, measure
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.geometry import se3, so3
from maplab_py.vimap import BaseFrames, Missions, Vertices, VIMap
from maplab_py.vimap.ids import random_ids
from maplab_py.vision.absolute_pose import PoseSolutions

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
        np.full(count, 0.5),
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
        vi_map, np.array(query), np.array(place), T_M_I, np.array(inliers), ConsensusRule()
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
