from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.guided_matching import guided_matches
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.vimap import VIMap
from maplab_py.vimap.vertex_removal import remove_vertices
from tests.algorithms.loop_closure.rooms import POINTS, Walk, make_map, room_points

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


def test_no_closures_give_no_matches():
    vi_map = single_tracks()
    closures = search_loops(vi_map)[0].closures
    nothing = np.zeros(len(closures), dtype=np.bool_)
    assert len(guided_matches(vi_map, closures, nothing, LoopClosureOptions()).keypoint) == 0


@pytest.mark.parametrize("kept", [4, 6])
def test_keyframes_that_share_no_track_are_merged(kept):
    vi_map, _ = make_map(TWICE)
    step = len(vi_map.vertices) // 2 // kept
    removed = np.arange(len(vi_map.vertices)) % step != 0
    sparse = remove_vertices(vi_map, removed)
    merged, report = close_loops(sparse, LoopClosureOptions(min_support=1))
    assert report.landmarks_merged > 0.5 * POINTS
    assert len(merged.landmarks) == len(sparse.landmarks) - report.landmarks_merged
