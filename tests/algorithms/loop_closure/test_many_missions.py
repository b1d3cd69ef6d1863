"""Loop closure over more missions of one place than a query is compared with."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure import candidates, detection, matching
from maplab_py.algorithms.loop_closure import features as features_module
from maplab_py.algorithms.loop_closure.features import map_features
from maplab_py.algorithms.loop_closure.matching import SearchMemory, match_features
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import search_loops
from maplab_py.geometry import yaw
from maplab_py.vision.index import MatchRule
from tests.algorithms.anchoring.test_anchoring import scrambled
from tests.algorithms.loop_closure.rooms import Walk, make_map

LIMITED = LoopClosureOptions(max_missions_per_query=2)
WALKS = [Walk(room=1, mission=m, vertices=6) for m in range(6)]
RULE = MatchRule(10 * 10**9)


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
    matches, landmarks = match_features(features, LIMITED, RULE, apart=True)
    assert missions_per_query(features, matches).max() == 2
    everywhere, same = match_features(features, LoopClosureOptions(), RULE, apart=True)
    assert missions_per_query(features, everywhere).max() == 5
    assert landmarks == same
    assert np.all(np.diff(matches.query) >= 0)


def test_few_missions_get_more_matches_each(room):
    _, features = room
    counts = []
    for options in (LIMITED, LoopClosureOptions()):
        matches, _ = match_features(features, options, RULE, apart=True)
        pairs = np.count_nonzero(
            features.descriptors.session[matches.query]
            != features.descriptors.session[matches.database]
        )
        counts.append(pairs / missions_per_query(features, matches).sum())
    assert counts[0] > 1.3 * counts[1]


def test_a_search_is_repeatable(room):
    _, features = room
    one, other = (match_features(features, LIMITED, RULE, apart=False)[0] for _ in range(2))
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))


def test_all_missions_are_anchored_although_each_query_sees_two():
    anchored, report = anchor_missions(scrambled(WALKS, known=[3], seed=1), loop_options=LIMITED)
    assert report.failure == ""
    assert len(report.anchored) == 5
    assert np.abs(yaw.from_pose(anchored.T_G_M)).max() < 0.05


def test_a_repeated_search_of_chosen_missions_builds_no_index(room, monkeypatch):
    _, features = room
    monkeypatch.setattr(matching.remembered, "__defaults__", (SearchMemory(),))
    first, _ = match_features(features, LIMITED, RULE, apart=True)
    monkeypatch.delattr(matching, "InvertedMultiIndex")
    again, _ = match_features(features, LIMITED, RULE, apart=False)  # both are searched anyway
    np.testing.assert_array_equal(first.database, again.database)
    half = np.arange(len(features)) % 2 == 0
    changed = dataclasses.replace(features, in_database=features.in_database & half)
    with pytest.raises(NameError):
        match_features(changed, LIMITED, RULE, apart=True)
    with pytest.raises(NameError):
        match_features(features, dataclasses.replace(LIMITED, seed=1), RULE, apart=True)


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
