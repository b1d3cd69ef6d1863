"""Place recognition on recorded maps against exhaustive search, and what tells look-alikes apart."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from tests.algorithms.loop_closure.against_truth import sessions
from tests.benchmarks.places.ambiguity import aliased_rooms, clarity, flight
from tests.benchmarks.places.euroc import compare
from tests.benchmarks.places.tango import pairs_of_loop
from tests.support.data import shared_data

pytestmark = pytest.mark.slow

LIMIT = LoopClosureOptions().max_ambiguous_ratio


def test_frame_pairs_of_the_walk_are_found():
    figures = pairs_of_loop(step=12)
    assert figures.pairs >= 30
    assert figures.found >= 25 / 30 * figures.pairs
    assert figures.closures_elsewhere == 0


def test_closures_of_the_flight_against_brute_force():
    figures = compare(query_step=4)
    assert figures.brute_vertices >= 15
    assert figures.recall >= 0.8
    assert figures.closures_judged > 150
    assert figures.closures_wrong == 0


def shares(vi_map):
    return np.array([pair.share for pair in clarity(vi_map) if len(pair.rows) >= 4])


def test_rooms_that_look_alike_are_beyond_the_limit():
    aliased = shares(aliased_rooms(seed=1, rate_hz=2.0))
    assert len(aliased) == 3
    assert aliased.min() > 2 * LIMIT


@pytest.mark.parametrize("make", [flight, lambda: sessions(0.15, 0.3, seed=1, rate_hz=2.0)[0]])
def test_missions_in_different_places_are_within_the_limit(make):
    shared_data("maplab_maps/euroc_v1_01")
    true = shares(make())
    assert len(true) >= 6
    assert true.max() < 0.5 * LIMIT
