"""Level of detail, playing a mission, and following positions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.viewer.building import Subject, build_scene, make_checked_drawing
from maplab_py.viewer.drawing import spread_rows
from maplab_py.viewer.options import PlaybackOptions
from maplab_py.viewer.playback import make_timeline, moved_scene
from maplab_py.viewer.scene import Points, Segments
from maplab_py.vimap.merge import merge_maps
from tests.vimap.builders import walk_map


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 400), st.integers(1, 500), st.integers(0, 100))
def test_spread_rows_are_as_many_as_allowed_and_each_once(n: int, limit: int, seed: int) -> None:
    p = np.random.default_rng(seed).normal(size=(n, 3))
    rows = spread_rows(p, limit)
    assert len(rows) == min(n, limit)
    assert (np.diff(rows) > 0).all()
    np.testing.assert_array_equal(rows, spread_rows(p, limit))


def test_spread_rows_cover_what_is_thin() -> None:
    rng = np.random.default_rng(0)
    dense = rng.normal(scale=0.05, size=(50_000, 3))
    thin = rng.uniform(-5.0, 5.0, (500, 3))
    rows = spread_rows(np.concatenate([dense, thin]), 2_000)
    assert np.count_nonzero(rows >= 50_000) > 450


def test_points_in_one_place_are_thinned_too() -> None:
    assert len(spread_rows(np.zeros((1000, 3)), 10)) == 10


@pytest.mark.parametrize("by_distance", [True, False])
def test_every_vertex_comes_once_in_order(by_distance: bool) -> None:
    vi_map = merge_maps(walk_map(seed=1), walk_map(vertices=9, seed=2, first_ns=10**10))[0]
    drawing = make_checked_drawing(Subject(vi_map))
    options = PlaybackOptions(steps=50, synchronize_missions_on_distance=by_distance)
    timeline = make_timeline(drawing, options)
    for mission, (start, stop) in enumerate(((0, 12), (12, 21))):
        own = timeline.vertex_step[start:stop]
        assert own[0] == 0
        assert own[-1] == 50
        assert (np.diff(own) >= 0).all()
        assert timeline.head[0, mission] == start
        assert timeline.head[-1, mission] == stop - 1
        for step in range(51):
            assert timeline.head[step, mission] == start + (own <= step).sum() - 1
    assert timeline.seconds[-1] == pytest.approx(1.1)


def test_missions_of_unlike_length_end_apart_when_not_stretched() -> None:
    vi_map = merge_maps(walk_map(seed=1), walk_map(vertices=7, seed=2, first_ns=10**10))[0]
    options = PlaybackOptions(
        steps=50,
        synchronize_missions_on_distance=False,
        synchronize_missions_on_distance_percent=False,
    )
    timeline = make_timeline(make_checked_drawing(Subject(vi_map)), options)
    assert timeline.vertex_step[11] == 50
    assert timeline.vertex_step[18] == pytest.approx(50 * 6 / 11, abs=1)


def test_landmarks_come_with_their_first_observer() -> None:
    vi_map = walk_map()
    timeline = make_timeline(make_checked_drawing(Subject(vi_map)), PlaybackOptions(steps=50))
    counts = np.diff(vi_map.observation_start)
    for row in np.flatnonzero(counts)[:20]:
        first = vi_map.keypoint_vertex[vi_map.landmark(row).keypoints].min()
        assert timeline.landmark_step[row] == timeline.vertex_step[first]
    assert (timeline.landmark_step[counts == 0] == 50).all()


def test_recent_landmarks_are_those_that_were_just_observed() -> None:
    vi_map = walk_map()
    drawing = make_checked_drawing(Subject(vi_map))
    timeline = make_timeline(drawing, PlaybackOptions(steps=50))
    rows, age = timeline.recent(drawing, 0)
    observed = vi_map.keypoints.landmark[vi_map.keypoint_vertex == 0]
    np.testing.assert_array_equal(rows, np.unique(observed[observed >= 0]))
    assert (age == 0.0).all()


def test_moved_scene_is_the_scene_of_the_moved_map() -> None:
    vi_map = walk_map()
    subject = Subject(vi_map)
    T = np.array(vi_map.vertices.T_M_I)
    T[:, 4] += np.linspace(0.0, 1.0, len(T))
    moved = vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T))
    quick = moved_scene(build_scene(subject), make_checked_drawing(subject), moved)
    full = build_scene(subject.replace(vi_map=moved))
    for layer in ("vertices", "landmarks", "trajectories"):
        for mission_id, part in full.layer(layer).parts.items():
            other = quick.layer(layer).parts[mission_id]
            if isinstance(part, Points):
                assert isinstance(other, Points)
                np.testing.assert_allclose(other.p, part.p, atol=1e-6)
            elif isinstance(part, Segments):
                assert isinstance(other, Segments)
                np.testing.assert_allclose(other.ends, part.ends, atol=1e-6)
    other_map = walk_map(vertices=5)
    scene = build_scene(subject)
    assert moved_scene(scene, make_checked_drawing(subject), other_map) is scene
