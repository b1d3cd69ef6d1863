"""Place recognition on recorded maps against exhaustive search, and what tells look-alikes apart."""

import dataclasses

import numpy as np
import pytest

from benchmarks.places.alike import ONE, measure, recorded, with_known
from benchmarks.places.ambiguity import aliased_rooms, clarity, flight, share
from benchmarks.places.euroc import compare
from benchmarks.places.tango import pairs_of_loop
from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from tests.algorithms.loop_closure.against_truth import is_right, joined

pytestmark = pytest.mark.slow

LIMIT = LoopClosureOptions().max_ambiguous_ratio


def test_frame_pairs_of_the_walk_are_found():
    figures = pairs_of_loop(step=12)
    assert figures.pairs >= 30
    assert figures.found >= 25 / 30 * figures.pairs
    assert figures.closures_elsewhere == 0


def test_closures_of_the_flight_against_brute_force():
    figures = compare(query_step=7)
    assert figures.brute_vertices >= 10
    assert figures.recall >= 0.8
    assert figures.closures_judged > 150
    assert figures.closures_wrong == 0


def test_rooms_that_look_alike_are_undecided():
    contests = clarity(aliased_rooms(seed=1, rate_hz=2.0))
    assert len(contests) == 3
    assert [c.winner for c in contests] == [-1, -1, -1]


def test_missions_in_places_of_their_own_are_decided():
    contests = [c for c in clarity(flight()) if len(c.pair.rows) >= 4]
    assert len(contests) >= 15
    # of few closures two that look alike are much: such a pair may be refused
    assert np.mean([c.winner >= 0 for c in contests]) >= 0.9
    assert max(share(c) for c in contests if len(c.pair.rows) >= 8) <= 0.6 * LIMIT


def test_sessions_in_two_rooms_that_look_alike_are_anchored():
    figures = next(measure(1))
    assert figures.visits == "both"
    assert figures.anchored == figures.expected == 2
    assert figures.farthest_m < 0.5
    assert figures.accepted > 500
    assert figures.accepted_wrong == 0
    assert figures.merges > 1000
    assert figures.wrong_after_optvi == 0


def test_sessions_in_one_of_two_rooms_that_look_alike_stay_unknown():
    vi_map = joined(recorded(1, ONE))
    anchored, report = anchor_missions(with_known(vi_map, 0))
    assert report.anchored == ()
    assert "look like other places" in report.failure
    assert {h.outcome for h in report.hypotheses} == {"undecided"}
    np.testing.assert_array_equal(anchored.T_G_M, vi_map.T_G_M)


def test_floors_that_look_alike_are_told_apart_by_the_rest_of_the_walk():
    scenario = load_scenario("alike_floors").with_seed(1)
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=3.0)
    scenario = dataclasses.replace(scenario, measurement=measurement)
    data = simulate(dataclasses.replace(scenario, sessions=scenario.sessions[:1]))
    search, report = search_loops(data.maps[0])
    right = is_right(data.maps[0], data.truth, search.closures)
    assert search.closures.accepted.sum() > 300
    assert np.all(right[search.closures.accepted])
    assert report.refused["looks the same as another place"] > 50
