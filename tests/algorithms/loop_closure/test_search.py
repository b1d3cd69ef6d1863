"""Searches: retrieval, scope, memory of earlier ones, guided matching."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure import matching
from maplab_py.algorithms.loop_closure.features import (
    PlaceIndex,
    ProjectionMemory,
    SearchScope,
    map_features,
)
from maplab_py.algorithms.loop_closure.guided_matching import guided_matches
from maplab_py.algorithms.loop_closure.matching import SearchMemory, match_features, nearest_rows
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.array_types import I32
from maplab_py.errors import EstimationError
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.vimap import VIMap
from maplab_py.vimap.excerpts import cut_by_time
from maplab_py.vimap.vertex_removal import remove_vertices
from maplab_py.vision.descriptors import DescriptorKind, pack_words
from maplab_py.vision.index import DescriptorSet, InvertedMultiIndex, MatchRule
from maplab_py.vision.projection import learn_projection
from tests.algorithms.loop_closure.rooms import POINTS, Walk, make_map, room_points
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


ANY = MatchRule()
OTHERS = MatchRule(other_sessions_only=True)


@pytest.fixture(scope="module")
def descriptors() -> DescriptorSet:
    label = np.repeat(np.arange(60), 4)
    raw = np.random.default_rng(3).integers(0, 256, (60, 16), dtype=np.uint8)[label]
    raw[:, 0] ^= np.random.default_rng(4).integers(0, 8, len(raw), dtype=np.uint8)
    return DescriptorSet(
        projected=learn_projection(raw, label, dimensions=4).project(raw),
        words=pack_words(raw),
        label=label,
        session=(np.arange(len(label)) % 3).astype(np.int32),
        time_ns=np.arange(len(label), dtype=np.int64) * 10**9,
    )


class _Counted:
    """Counts how many indices are built."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.built = 0
        monkeypatch.setattr(matching, "InvertedMultiIndex", self)

    def __call__(self, database: DescriptorSet, **settings: Any) -> InvertedMultiIndex:
        self.built += 1
        return InvertedMultiIndex(database, **settings)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> _Counted:
    return _Counted(monkeypatch)


def _search(
    memory: SearchMemory,
    database: DescriptorSet,
    queries: DescriptorSet,
    rules: list[MatchRule],
    k: int = 2,
    max_difference: float = np.inf,
) -> list[I32]:
    return nearest_rows(
        database,
        queries,
        k,
        rules,
        seed=0,
        words_per_query=4,
        max_difference=max_difference,
        memory=memory,
    )


def test_the_result_is_that_of_the_index(descriptors: DescriptorSet) -> None:
    index = InvertedMultiIndex(descriptors, cells_per_query=4)
    memory = SearchMemory()
    for _ in range(2):
        results = _search(memory, descriptors, descriptors, [ANY, OTHERS])
        for rows, rule in zip(results, (ANY, OTHERS), strict=True):
            np.testing.assert_array_equal(rows, index.nearest(descriptors, 2, rule).row)
    assert len(memory) == 2


def test_equal_searches_build_one_index(descriptors: DescriptorSet, counted: _Counted) -> None:
    memory = SearchMemory()
    everything = np.arange(len(descriptors))
    first = _search(memory, descriptors, descriptors, [ANY])
    again = _search(memory, descriptors.take(everything), descriptors.take(everything), [ANY])
    assert counted.built == 1
    assert again[0] is first[0]
    with pytest.raises(ValueError, match="read-only"):
        first[0][0, 0] = 5
    _search(memory, descriptors, descriptors, [ANY, OTHERS])  # one of the two is new
    assert counted.built == 2
    assert len(memory) == 2


@pytest.mark.parametrize("column", ["projected", "words", "label", "session", "time_ns"])
def test_any_change_is_searched(descriptors: DescriptorSet, counted: _Counted, column: str) -> None:
    memory = SearchMemory()
    _search(memory, descriptors, descriptors, [ANY])
    values = np.array(getattr(descriptors, column))
    values[-1] += 1
    changed = dataclasses.replace(descriptors, **{column: values})
    _search(memory, changed, descriptors, [ANY])
    _search(memory, descriptors, changed, [ANY])
    _search(memory, descriptors, descriptors, [ANY], k=3)
    _search(memory, descriptors, descriptors, [ANY], max_difference=20.0)
    _search(memory, descriptors, descriptors, [MatchRule(10**9)])
    assert counted.built == 6
    assert len(memory) == 6


def test_the_oldest_results_are_dropped(descriptors: DescriptorSet, counted: _Counted) -> None:
    size = _search(SearchMemory(), descriptors, descriptors, [ANY])[0].nbytes
    memory = SearchMemory(max_bytes=2 * size)
    for rule in (ANY, OTHERS, ANY, MatchRule(10**9)):  # ANY is used again, so OTHERS is oldest
        _search(memory, descriptors, descriptors, [rule])
    assert len(memory) == 2
    counted.built = 0
    _search(memory, descriptors, descriptors, [ANY])
    assert counted.built == 0
    _search(memory, descriptors, descriptors, [OTHERS])
    assert counted.built == 1


TWICE = [
    Walk(room=1, vertices=24),
    Walk(room=1, vertices=24, start_s=60.0, drift=(0.02, -0.01, 0.01, 0.002)),
]
FEW_CELLS = LoopClosureOptions(num_words_for_nn_search=1)
"""The index misses many landmarks."""


def points(vi_map: VIMap) -> np.ndarray:
    """Return the point of the room (K,) that each keypoint shows, by its descriptor."""
    bits = np.unpackbits(vi_map.keypoints.descriptor, axis=1).astype(np.int32)
    room = np.unpackbits(room_points(1)[1], axis=1).astype(np.int32)
    return np.argmin(bits.sum(1)[:, None] + room.sum(1)[None] - 2 * bits @ room.T, axis=1)


def single_tracks() -> VIMap:
    """Return a map of which half the landmarks have a single observer, as after keyframing."""
    vi_map, _ = make_map(TWICE, flips=0.1)
    landmark = vi_map.keypoints.landmark.copy()
    rng = np.random.default_rng(4)
    for row in rng.permutation(len(vi_map.landmarks))[::2]:
        rows = np.flatnonzero(landmark == row)
        landmark[np.delete(rows, rng.integers(len(rows)))] = -1
    return vi_map.replace(keypoints=vi_map.keypoints.replace(landmark=landmark))


def test_more_landmarks_are_merged_and_none_with_another_point():
    vi_map = single_tracks()
    plain, _ = close_loops(vi_map, dataclasses.replace(FEW_CELLS, guided_matching=False))
    guided, _ = close_loops(vi_map, FEW_CELLS)
    assert len(plain.landmarks) - len(guided.landmarks) >= 10
    point = points(guided)
    observed = guided.keypoints.landmark >= 0
    pairs = np.stack([guided.keypoints.landmark[observed], point[observed]])
    owners = np.unique(pairs, axis=1)[0]
    assert len(np.unique(owners)) == len(owners)


def test_matches_are_of_one_point_near_the_keypoint_and_new():
    vi_map = single_tracks()
    closures = search_loops(vi_map)[0].closures
    matches = guided_matches(vi_map, closures, closures.accepted, LoopClosureOptions())
    assert len(matches.keypoint) > 100
    assert np.all(closures.accepted[matches.closure])
    vertex = vi_map.keypoint_vertex[matches.keypoint]
    np.testing.assert_array_equal(vertex, closures.query_vertex[matches.closure])
    point = points(vi_map)
    first = vi_map.observations[vi_map.observation_start[matches.landmark]]
    np.testing.assert_array_equal(point[matches.keypoint], point[first])
    seen = set(
        zip(vi_map.keypoint_vertex.tolist(), vi_map.keypoints.landmark.tolist(), strict=True)
    )
    assert seen.isdisjoint(zip(vertex.tolist(), matches.landmark.tolist(), strict=True))


def test_other_descriptors_are_not_matched():
    vi_map = single_tracks()
    closures = search_loops(vi_map)[0].closures
    strict = dataclasses.replace(LoopClosureOptions(), max_bit_fraction=0.0)
    matches = guided_matches(vi_map, closures, closures.accepted, strict)
    assert np.all(matches.bits == 0)
    noise = np.random.default_rng(1).integers(0, 256, vi_map.keypoints.descriptor.shape, np.uint8)
    other = vi_map.replace(keypoints=vi_map.keypoints.replace(descriptor=noise))
    empty = guided_matches(other, closures, closures.accepted, LoopClosureOptions())
    assert len(empty.keypoint) == 0


@pytest.mark.parametrize("kept", [4, 6])
def test_keyframes_that_share_no_track_are_merged(kept):
    vi_map, _ = make_map(TWICE)
    step = len(vi_map.vertices) // 2 // kept
    removed = np.arange(len(vi_map.vertices)) % step != 0
    sparse = remove_vertices(vi_map, removed)
    merged, report = close_loops(sparse, LoopClosureOptions(min_support=1))
    assert report.landmarks_merged > 0.5 * POINTS
    assert len(merged.landmarks) == len(sparse.landmarks) - report.landmarks_merged
