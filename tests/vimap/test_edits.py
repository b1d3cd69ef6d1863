"""Edits of maps, parts of them, and what they hold."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.vimap import DescriptorBlock, VIMap, edits, merge, table, vertex_removal
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edits import merge_landmarks, remove_keypoints, with_p_G
from maplab_py.vimap.excerpts import cut_by_time, excerpt, mission_maps
from tests.algorithms.loop_closure.rooms import Walk, make_map
from tests.simulation.small import simulated
from tests.vimap.builders import SAMPLES, walk_map


def same_places(before: VIMap, after: VIMap) -> None:
    rows = before.landmark_index.rows(after.landmarks.id)
    np.testing.assert_allclose(after.p_G, before.p_G[rows], atol=1e-12)


def test_removed_vertices_join_imu_and_odometry():
    m = walk_map()
    after, report = vertex_removal.remove_vertices_counted(m, [3, 4, 5, 7])
    assert check_consistency(after).errors == ()
    assert report.vertices == 4
    assert len(after.vertices) == len(m.vertices) - 4
    np.testing.assert_array_equal(
        np.unique(after.imu_samples.timestamp_ns), np.unique(m.imu_samples.timestamp_ns)
    )
    edge = int(np.flatnonzero(after.imu_edges.from_vertex == 2)[0])
    assert after.imu_edges.sample_count[edge] == 4 * SAMPLES - 3
    T = after.vertices.T_M_I
    e = after.transformation_edges
    np.testing.assert_allclose(e.T_A_B, se3.relative(T[e.from_vertex], T[e.to_vertex]), atol=1e-12)
    same_places(m, after)


def test_what_hangs_on_a_removed_vertex_goes_and_is_counted():
    m = walk_map()
    after, report = vertex_removal.remove_vertices_counted(m, [1, 2])
    assert report.loop_closure_edges == 1
    assert report.absolute_poses == 1
    gone = np.isin(m.keypoint_vertex, [1, 2])
    assert report.observations == np.count_nonzero(gone & (m.keypoints.landmark >= 0))
    assert len(after.keypoints) == np.count_nonzero(~gone)


def test_an_edge_type_that_one_link_lacks_is_dropped():
    m = walk_map()
    m = m.replace(transformation_edges=m.transformation_edges.take(np.arange(1, 11)))
    after, report = vertex_removal.remove_vertices_counted(m, [1])
    assert report.transformation_edges_dropped == 1
    assert not np.any(after.transformation_edges.from_vertex == 0)
    assert check_consistency(after).errors == ()


def test_the_ends_of_a_mission_may_go():
    m = walk_map()
    after = edits.remove_vertices(m, [0, 1, 11])
    assert check_consistency(after).errors == ()
    assert after.missions.root_vertex[0] == 0
    same_places(m, after)


def test_a_mission_cannot_lose_all_vertices():
    with pytest.raises(UserError, match="remove the mission"):
        edits.remove_vertices(walk_map(), np.arange(12))


def test_composed_covariance_is_that_of_samples():
    rng = np.random.default_rng(1)
    T_1, T_2 = se3.retract(se3.identity(2), rng.normal(size=(2, 6)))
    c_1, c_2 = np.diag(rng.uniform(1e-8, 1e-7, (2, 6))[0]), np.diag(rng.uniform(1e-8, 1e-7, 6))
    n = 200_000
    d_1 = rng.multivariate_normal(np.zeros(6), c_1, n)
    d_2 = rng.multivariate_normal(np.zeros(6), c_2, n)
    noisy = se3.compose(se3.retract(T_1, d_1), se3.retract(T_2, d_2))
    sampled = np.cov(se3.local(se3.compose(T_1, T_2), noisy).T)
    expected = vertex_removal.composed_covariance(T_1[None], c_1[None], T_2[None], c_2[None])[0]
    np.testing.assert_allclose(expected, sampled, atol=0.02 * np.max(np.abs(expected)))


def test_merged_landmarks_share_their_observations():
    m = walk_map()
    count = np.diff(m.observation_start)
    a, b = np.argsort(count)[:2]
    after = edits.merge_landmarks(m, [b], [a])
    assert len(after.landmarks) == len(m.landmarks) - 1
    row = after.landmark_index.rows(m.landmarks.id[[a]])[0]
    frames = after.keypoint_frame[after.landmark(row).keypoints]
    assert len(frames) == len(np.unique(frames))
    both = np.concatenate([m.landmark(a).keypoints, m.landmark(b).keypoints])
    assert set(frames) == set(m.keypoint_frame[both])
    kept = m.landmark(a).keypoints
    np.testing.assert_array_equal(after.keypoints.landmark[kept], row)


def test_chains_and_rings_of_merges_end_in_one_landmark():
    m = walk_map()
    after = edits.merge_landmarks(m, [1, 2, 3, 3], [2, 5, 1, 3])
    assert len(after.landmarks) == len(m.landmarks) - 3
    assert after.landmark_index.rows(m.landmarks.id[[5]])[0] >= 0
    ring = edits.merge_landmarks(m, [7, 8], [8, 7])
    assert ring.landmark_index.rows(m.landmarks.id[[7, 8]]).tolist() == [7, -1]


def test_rows_out_of_range_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        edits.remove_landmarks(walk_map(), [60])


def test_new_ids_are_new_and_reproducible():
    m = walk_map()
    once, again = edits.with_new_ids(m), edits.with_new_ids(m)
    twice = edits.with_new_ids(once)
    for name in ("missions", "vertices", "frames", "landmarks", "imu_edges", "baseframes"):
        first, second = getattr(once, name).id, getattr(twice, name).id
        np.testing.assert_array_equal(first, getattr(again, name).id)
        assert not np.any(np.all(first == getattr(m, name).id, axis=1))
        assert not np.any(np.all(first == second, axis=1))
    assert check_consistency(once).errors == ()


def test_an_edit_leaves_the_map_as_it_was():
    m = walk_map()
    landmark, count = m.keypoints.landmark.copy(), len(m.vertices)
    edits.remove_vertices(m, [4])
    edits.remove_observations(m, [0, 1])
    np.testing.assert_array_equal(m.keypoints.landmark, landmark)
    assert len(m.vertices) == count


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 2**31)), max_size=6))
def test_any_sequence_of_edits_stays_consistent(operations):
    m = walk_map()
    for kind, seed in operations:
        rng = np.random.default_rng(seed)
        vertices, landmarks = len(m.vertices), len(m.landmarks)
        if kind == 0 and vertices > 2:
            m = edits.remove_vertices(m, rng.choice(vertices, rng.integers(1, vertices - 1), False))
        elif kind == 1:
            m = edits.remove_landmarks(m, rng.random(landmarks) < 0.2)
        elif kind == 2 and landmarks:
            m = edits.merge_landmarks(m, *rng.integers(0, landmarks, (2, 5)))
        elif kind == 3:
            m = edits.remove_observations(m, rng.random(len(m.keypoints)) < 0.2)
        rules = [v.rule for v in check_consistency(m).errors if "twice in a frame" not in v.rule]
        assert rules == []


@pytest.fixture(scope="module")
def both() -> VIMap:
    first, second = simulated().maps
    return merge.merge_maps(first, second)[0]


def test_an_excerpt_is_a_consistent_map_of_its_vertices_and_what_they_observe(both: VIMap) -> None:
    rows = np.arange(5, 20)
    part = excerpt(both, rows)
    assert check_consistency(part.vi_map).errors == ()
    assert np.array_equal(part.vi_map.vertices.id, both.vertices.id[rows])
    assert len(part.vi_map.imu_edges) == len(rows) - 1
    assert np.array_equal(part.vi_map.landmarks.id, both.landmarks.id[part.landmarks])
    np.testing.assert_allclose(part.vi_map.p_G, both.p_G[part.landmarks], atol=1e-9)
    assert np.array_equal(part.vi_map.keypoints.uv_px, both.keypoints.uv_px[part.keypoints])
    keypoints = both.observations[np.isin(both.keypoint_vertex[both.observations], rows)]
    assert np.array_equal(np.unique(both.keypoints.landmark[keypoints]), part.landmarks)


def test_landmarks_can_be_limited_to_those_of_some_vertices(both: VIMap) -> None:
    part = excerpt(both, np.arange(10), observed_by=np.arange(3))
    assert np.array_equal(part.landmarks, excerpt(both, np.arange(3)).landmarks)
    assert len(part.vertices) == 10


def test_an_unchanged_excerpt_changes_nothing(both: VIMap) -> None:
    part = excerpt(both, np.arange(3, len(both.vertices), 2))
    back = part.written_back(part.vi_map)
    assert back.keypoints is both.keypoints
    np.testing.assert_allclose(back.p_G, both.p_G, atol=1e-9)
    for name in ("T_M_I", "v_M", "gyro_bias"):
        assert np.array_equal(getattr(back.vertices, name), getattr(both.vertices, name))


def test_states_of_the_part_come_back_and_others_stay(both: VIMap) -> None:
    rows = np.arange(4, 9)
    part = excerpt(both, rows)
    v = part.vi_map.vertices
    T_M_I = v.T_M_I + np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3])
    moved = part.vi_map.replace(vertices=v.replace(T_M_I=T_M_I, v_M=v.v_M + 1.0))
    moved = with_p_G(moved, np.array([0]), np.array([[1.0, 2.0, 3.0]]))
    back = part.written_back(moved)
    np.testing.assert_allclose(back.T_G_I[rows], moved.T_G_I, atol=1e-12)
    np.testing.assert_allclose(back.vertices.v_M[rows], both.vertices.v_M[rows] + 1.0)
    np.testing.assert_allclose(back.p_G[part.landmarks], moved.p_G, atol=1e-9)
    others = np.setdiff1d(np.arange(len(both.vertices)), rows)
    assert np.array_equal(back.vertices.T_M_I[others], both.vertices.T_M_I[others])


def test_landmarks_merged_in_the_part_are_merged_everywhere(both: VIMap) -> None:
    rows = np.arange(10)
    part = excerpt(both, rows)
    source, target = 3, 8
    merged = merge_landmarks(part.vi_map, [source], [target])
    back = part.written_back(merged)
    assert check_consistency(back).errors == ()
    assert len(back.landmarks) == len(both.landmarks) - 1
    assert (back.landmark_index.rows(both.landmarks.id[part.landmarks[[source]]]) < 0).all()
    whole = merge_landmarks(both, part.landmarks[[source]], part.landmarks[[target]])
    assert np.array_equal(back.landmarks.id, whole.landmarks.id)
    assert np.array_equal(back.keypoints.landmark, whole.keypoints.landmark)


def test_base_frames_of_the_part_come_back(both: VIMap) -> None:
    part = excerpt(both, both.vertices.mission == 1)
    frames = part.vi_map.baseframes
    T_G_M = frames.T_G_M + np.array([0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0])
    known = np.ones(len(frames), dtype=np.bool_)
    back = part.written_back(
        part.vi_map.replace(baseframes=frames.replace(T_G_M=T_G_M, is_known=known))
    )
    assert bool(back.baseframes.is_known[back.missions.baseframe[1]])
    np.testing.assert_allclose(back.T_G_M[1] - both.T_G_M[1], [0, 0, 0, 0, 5, 0, 0])
    assert np.array_equal(back.T_G_M[0], both.T_G_M[0])


def test_an_edit_that_removes_vertices_is_refused(both: VIMap) -> None:
    part = excerpt(both, np.arange(8))
    with pytest.raises(ValueError, match="number of vertices"):
        part.written_back(excerpt(both, np.arange(7)).vi_map)


def test_a_short_session_is_one_submap() -> None:
    session = simulated().maps[1]
    assert len(cut_by_time(session, 100.0)) == 1


def test_each_mission_becomes_a_map(both: VIMap) -> None:
    parts = mission_maps(both)
    assert [len(part.missions) for part in parts] == [1, 1]
    assert sum(len(part.vertices) for part in parts) == len(both.vertices)


EDGES = "vertex without an edge to the next of its mission"


def two_types():  # type: ignore[no-untyped-def]
    """Return a map whose frames have a Binary and a SIFT block each."""
    vi_map, _ = make_map([Walk(room=1, vertices=5)])
    rng = np.random.default_rng(0)
    descriptor = rng.integers(1, 200, (len(vi_map.keypoints), 128), dtype=np.uint8)
    blocks = [
        (DescriptorBlock(count // 3, 48), DescriptorBlock(count - count // 3, 128, 0, 3))
        for count in vi_map.frames.keypoint_count.tolist()
    ]
    return vi_map.replace(
        frames=vi_map.frames.replace(descriptor_blocks=table.object_column(blocks)),
        keypoints=vi_map.keypoints.replace(descriptor=descriptor),
    )


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_the_kept_keypoints_keep_what_they_have(seed: int, share: float) -> None:
    vi_map = two_types()
    removed = np.random.default_rng(seed).random(len(vi_map.keypoints)) < share
    result = remove_keypoints(vi_map, removed)
    errors = check_consistency(result).errors
    assert {error.rule for error in errors} <= {EDGES}  # which the map of rooms has none of
    np.testing.assert_array_equal(result.feature_type, vi_map.feature_type[~removed])
    np.testing.assert_array_equal(result.keypoint_frame, vi_map.keypoint_frame[~removed])
    np.testing.assert_array_equal(
        result.keypoints.descriptor, vi_map.keypoints.descriptor[~removed]
    )
    left = vi_map.keypoints.landmark[~removed]
    observed = np.unique(left[left >= 0])
    np.testing.assert_array_equal(result.landmarks.id, vi_map.landmarks.id[observed])


def test_nothing_removed_is_the_same_map() -> None:
    vi_map = two_types()
    assert remove_keypoints(vi_map, np.zeros(len(vi_map.keypoints), dtype=np.bool_)) is vi_map
    none = remove_keypoints(vi_map, np.ones(len(vi_map.keypoints), dtype=np.bool_))
    assert len(none.keypoints) == len(none.landmarks) == 0
    assert set(none.frames.descriptor_blocks.tolist()) == {()}
