"""Retrieval of stretches that look alike."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.features import PlaceIndex
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.vimap import VIMap
from maplab_py.vimap.excerpts import cut_by_time
from tests.simulation.small import simulated

ROUNDS = Scenario(
    name="rounds",
    world=WorldOptions(landmarks_per_room=2500),
    measurement=MeasurementOptions(frame_rate_hz=4.0, max_keypoints=150),
    sessions=(SessionOptions(duration_s=24.0, turns=2.0),),
)
"""Two rounds in a room: a stretch of the second looks like one of the first."""


@pytest.fixture(scope="module")
def stretches() -> list[VIMap]:
    return cut_by_time(simulated(ROUNDS).maps[0], 3.0)


def test_a_stretch_is_recognised_when_the_robot_comes_back(stretches: list[VIMap]) -> None:
    index = PlaceIndex()
    assert index.train(simulated(ROUNDS).maps[0])
    half = len(stretches) // 2
    for stretch in stretches[:half]:
        index.add(index.frequencies(stretch))
    assert len(index) == half
    best = [int(index.similar(index.frequencies(s), 1)[0]) for s in stretches[half:]]
    assert best == list(range(half))


def test_it_answers_nothing_before_it_is_trained_and_without_features(
    stretches: list[VIMap],
) -> None:
    index = PlaceIndex()
    assert not index.is_trained
    assert not index.frequencies(stretches[0]).any()
    index.add(index.frequencies(stretches[0]))
    assert not len(index.similar(index.frequencies(stretches[1]), 3))
    bare = VIMap()
    assert not index.train(bare)


def test_frequencies_of_some_vertices_are_those_of_their_part() -> None:
    index, session = PlaceIndex(), simulated(ROUNDS).maps[0]
    assert index.train(session)
    stretch = cut_by_time(session, 3.0)[2]
    rows = session.vertex_index.rows(stretch.vertices.id)
    assert np.allclose(index.frequencies(session, rows), index.frequencies(stretch))
