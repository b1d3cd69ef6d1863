"""Searches of a few vertices in a growing map, and the projection that they share."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.features import ProjectionMemory, SearchScope, map_features
from maplab_py.algorithms.loop_closure.matching import match_features
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.errors import EstimationError
from maplab_py.vimap import VIMap
from maplab_py.vision.descriptor_kind import DescriptorKind
from maplab_py.vision.index import MatchRule
from tests.algorithms.loop_closure.rooms import Walk, make_map

RULE = MatchRule(10_000_000_000)
KIND = DescriptorKind(8)


def room() -> VIMap:
    """Return a map of four missions that see one room."""
    return make_map([Walk(room=1, mission=m, vertices=6) for m in range(4)])[0]


def tracks(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return descriptors (5 * count, 8) and the tracks that they belong to."""
    label = np.repeat(np.arange(count), 5)
    rng = np.random.default_rng(seed)
    noise = rng.random((5 * count, 8, 8)) < 0.05
    bits = rng.integers(0, 256, (count, 8), dtype=np.uint8)[label]
    return bits ^ np.packbits(noise, axis=2)[:, :, 0], label


def test_a_projection_is_kept_until_there_is_twice_as_much_to_learn_from() -> None:
    memory = ProjectionMemory()
    first = memory.learned(*tracks(100), KIND, 4)
    assert memory.learned(*tracks(200, seed=1), KIND, 4) is first
    larger = memory.learned(*tracks(201, seed=1), KIND, 4)
    assert larger is not first
    assert memory.learned(*tracks(60), KIND, 4) is larger


def test_other_descriptors_and_dimensions_get_a_projection_of_their_own() -> None:
    memory = ProjectionMemory()
    first = memory.learned(*tracks(100), KIND, 4)
    assert len(memory.learned(*tracks(100), KIND, 3).matrix) == 3
    descriptors, label = tracks(100)
    other = memory.learned(np.concatenate([descriptors] * 2, axis=1), label, DescriptorKind(16), 3)
    assert other.kind.size == 16
    assert first.kind.size == 8


def test_too_few_tracks_leave_the_kept_projection() -> None:
    memory = ProjectionMemory()
    first = memory.learned(*tracks(100), KIND, 4)
    with pytest.raises(EstimationError, match="fewer than"):
        memory.learned(*tracks(10), DescriptorKind(8, 1), 4)
    assert memory.learned(*tracks(100), KIND, 4) is first


@pytest.mark.parametrize("limit", [10, 1], ids=["all missions", "chosen missions"])
def test_the_matches_of_some_queries_are_those_that_they_have_among_all(limit: int) -> None:
    vi_map = room()
    features, _ = map_features(vi_map, np.arange(len(vi_map.missions)))
    options = LoopClosureOptions(max_missions_per_query=limit)
    asked = np.flatnonzero(features.vertex % 3 == 0)
    every, landmarks = match_features(features, options, RULE, apart=False)
    some, same = match_features(features, options, RULE, False, asked)
    assert landmarks == same
    kept = np.isin(every.query, asked)
    assert 0 < kept.sum() < len(every)
    for name in ("query", "database", "bits"):
        np.testing.assert_array_equal(getattr(some, name), getattr(every, name)[kept])
    none, _ = match_features(features, options, RULE, False, asked[:0])
    assert len(none) == 0


def test_only_the_queries_are_closed_with_all_places() -> None:
    vi_map = room()
    asked = vi_map.vertices.mission == 1
    merged, report = close_loops(vi_map, scope=SearchScope(asked, ProjectionMemory()))
    _, everything = close_loops(vi_map)
    assert report.query_vertices == np.count_nonzero(asked)
    assert 0 < report.accepted < everything.accepted
    assert len(merged.landmarks) < len(vi_map.landmarks)
    unasked = np.zeros_like(asked)
    same, report = close_loops(vi_map, scope=SearchScope(unasked))
    assert report.candidates == 0
    assert len(same.landmarks) == len(vi_map.landmarks)
