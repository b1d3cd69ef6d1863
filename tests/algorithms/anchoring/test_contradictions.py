"""Missions that meet in a room which only looks like one and the same: the others outvote it."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.geometry import yaw
from tests.algorithms.anchoring.test_anchoring import scrambled
from tests.algorithms.loop_closure.rooms import Walk

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
