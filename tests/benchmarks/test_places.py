"""Place recognition on recorded maps against exhaustive search, and what tells look-alikes apart."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from tests.benchmarks.places.ambiguity import aliased_rooms, clarity, flight
from tests.benchmarks.places.euroc import compare
from tests.benchmarks.places.tango import pairs_of_loop

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


def test_rooms_that_look_alike_are_beyond_the_limit():
    pairs = clarity(aliased_rooms(seed=1, rate_hz=2.0))
    assert len(pairs) == 3
    assert min(pair.share for pair in pairs) > 2 * LIMIT


def test_missions_in_places_of_their_own_are_within_the_limit():
    pairs = [pair for pair in clarity(flight()) if len(pair.rows) >= 4]
    assert len(pairs) >= 15
    # of few closures two that look alike are much: such a pair may be refused
    assert np.mean([pair.share <= LIMIT for pair in pairs]) >= 0.9
    assert max(pair.share for pair in pairs if len(pair.rows) >= 8) <= 0.6 * LIMIT
