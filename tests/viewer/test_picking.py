"""A click or an id leads to what it names; playing a mission; level of detail."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.errors import UserError
from maplab_py.viewer.building import Subject, build_scene, make_checked_drawing
from maplab_py.viewer.drawing import make_drawing, spread_rows
from maplab_py.viewer.facts import facts
from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions
from maplab_py.viewer.picking import find_by_id, pick
from maplab_py.viewer.playback import make_timeline, moved_scene
from maplab_py.viewer.scene import Entity, Points, Segments
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.merge import merge_maps
from tests.vimap.builders import walk_map

MAP = walk_map(vertices=14, landmarks=80, seed=3)
SCENE = build_scene(Subject(MAP))
EYE = SCENE.extent.centre + np.array([-6.0, -9.0, 7.0])


@pytest.mark.parametrize("row", range(14))
def test_every_vertex_can_be_picked(row: int) -> None:
    found = pick(SCENE, EYE, MAP.T_G_I[row, 4:] - EYE)
    assert found is not None
    assert (found.entity, found.row) == (Entity.VERTEX, row)
    assert found.angle_rad < 1e-3


@pytest.mark.parametrize("row", range(0, 80, 9))
def test_landmarks_can_be_picked(row: int) -> None:
    found = pick(SCENE, EYE, MAP.p_G[row] - EYE, layers={"landmarks"})
    assert found is not None
    assert (found.entity, found.row) == (Entity.LANDMARK, row)


def test_a_loop_closure_is_picked_along_its_line() -> None:
    edges = MAP.loop_closure_edges
    ends = MAP.T_G_I[[edges.from_vertex[0], edges.to_vertex[0]], 4:]
    target = 0.7 * ends[0] + 0.3 * ends[1]
    found = pick(SCENE, EYE, target - EYE, layers={"loop_closures"})
    assert found is not None
    assert (found.entity, found.row) == (Entity.LOOP_CLOSURE, 0)
    np.testing.assert_allclose(found.p, target, atol=0.02)


def test_hidden_things_and_things_behind_are_not_picked() -> None:
    ray = MAP.T_G_I[5, 4:] - EYE
    assert pick(SCENE, EYE, ray, layers=set()) is None
    assert pick(SCENE, EYE, ray, missions=set(), layers={"vertices"}) is None
    assert pick(SCENE, EYE, -ray) is None
    assert pick(SCENE, EYE, [0.0, 0.0, 1.0]) is None


def test_the_front_one_of_two_on_a_line_is_picked() -> None:
    p = MAP.T_G_I[:, 4:]
    eye = p[3] + 0.2 * (p[3] - p[9]) / np.linalg.norm(p[3] - p[9])
    found = pick(SCENE, eye, p[9] - eye, layers={"vertices"})
    assert found is not None
    assert found.row == 3


def _value(entity: Entity, row: int, name: str) -> str:
    return dict(facts(MAP, entity, row))[name]


def test_facts_of_a_vertex() -> None:
    assert _value(Entity.VERTEX, 4, "vertex") == to_hex(MAP.vertices.id[4])[:8]
    assert _value(Entity.VERTEX, 4, "time") == "0.400 s after the start"
    assert _value(Entity.VERTEX, 4, "number") == "5 of 14"
    observed = MAP.keypoints.landmark[MAP.keypoint_vertex == 4]
    assert _value(Entity.VERTEX, 4, "observations") == str((observed >= 0).sum())
    assert _value(Entity.VERTEX, 4, "reprojection error") == "mean 0.00 px, largest 0.00 px"


def test_facts_of_a_landmark() -> None:
    row = int(np.argmax(np.diff(MAP.observation_start)))
    keypoints = MAP.landmark(row).keypoints
    vertices = np.unique(MAP.keypoint_vertex[keypoints])
    assert _value(Entity.LANDMARK, row, "landmark") == to_hex(MAP.landmarks.id[row])[:8]
    text = f"{len(keypoints)} by {len(vertices)} vertices"
    assert _value(Entity.LANDMARK, row, "observations") == text
    assert _value(Entity.LANDMARK, row, "quality") == "good"
    assert _value(Entity.LANDMARK, row, "reprojection error").startswith("mean 0.00 px")
    shifted = np.array(MAP.keypoints.uv_px)
    shifted[keypoints, 0] += 3.0
    worse = MAP.replace(keypoints=MAP.keypoints.replace(uv_px=shifted))
    error = dict(facts(worse, Entity.LANDMARK, row))["reprojection error"]
    assert error == "mean 3.00 px, largest 3.00 px"


def test_facts_of_a_loop_closure() -> None:
    edges = MAP.loop_closure_edges
    named = dict(facts(MAP, Entity.LOOP_CLOSURE, 1))
    assert named["query vertex"] == to_hex(MAP.vertices.id[edges.from_vertex[1]])[:8]
    assert named["target vertex"] == to_hex(MAP.vertices.id[edges.to_vertex[1]])[:8]
    # the edge says the two are at the same place
    p = MAP.T_G_I[[edges.from_vertex[1], edges.to_vertex[1]], 4:]
    assert named["correction"] == f"{np.linalg.norm(p[1] - p[0]):.3f} m"
    assert named["switch value"] == "1.000"


WALK = walk_map()
DRAWING = make_drawing(WALK, VisualizationOptions())


@pytest.mark.parametrize("digits", [12, 16, 20, 32])
def test_ids_and_their_beginnings_are_understood(digits: int) -> None:
    vertex = find_by_id(DRAWING, to_hex(WALK.vertices.id[3])[:digits])
    assert (vertex.entity, vertex.row) == (Entity.VERTEX, 3)
    np.testing.assert_allclose(vertex.p, WALK.T_G_I[3, 4:])
    landmark = find_by_id(DRAWING, f"  {to_hex(WALK.landmarks.id[7])[:digits].upper()} ")
    assert (landmark.entity, landmark.row) == (Entity.LANDMARK, 7)
    np.testing.assert_allclose(landmark.p, WALK.p_G[7])
    closure = find_by_id(DRAWING, to_hex(WALK.loop_closure_edges.id[1])[:digits])
    assert (closure.entity, closure.row) == (Entity.LOOP_CLOSURE, 1)
    mission = find_by_id(DRAWING, to_hex(WALK.missions.id[0])[:digits])
    assert (mission.entity, mission.row) == (Entity.VERTEX, 0)


def test_ids_that_mean_nothing_are_refused() -> None:
    for text in ("abc", "hello", "0" * 33, ""):
        with pytest.raises(UserError, match="4 to 32 hexadecimal digits"):
            find_by_id(DRAWING, text)
    with pytest.raises(UserError, match="no vertex, landmark, loop closure or mission"):
        find_by_id(DRAWING, "0" * 32)


def test_a_beginning_of_several_ids_asks_for_more_digits() -> None:
    ids = np.array(WALK.vertices.id)
    ids[5] = ids[4] + np.array([0, 1], dtype=np.uint64)
    vi_map = WALK.replace(vertices=WALK.vertices.replace(id=ids))
    drawing = make_drawing(vi_map, VisualizationOptions())
    with pytest.raises(UserError, match=r"2 ids start with .* \(vertex\): give more digits"):
        find_by_id(drawing, to_hex(ids[4])[:20])


def test_a_landmark_without_position_is_not_shown() -> None:
    p_I = np.array(WALK.landmarks.p_I)
    p_I[2] = np.nan
    vi_map = WALK.replace(landmarks=WALK.landmarks.replace(p_I=p_I))
    drawing = make_drawing(vi_map, VisualizationOptions())
    with pytest.raises(UserError, match="this landmark has no finite position"):
        find_by_id(drawing, to_hex(vi_map.landmarks.id[2]))


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
