import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap, edits
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edge_joining import composed_covariance
from maplab_py.vimap.vertex_removal import remove_vertices_counted
from tests.vimap.builders import SAMPLES, walk_map


def same_places(before: VIMap, after: VIMap) -> None:
    rows = before.landmark_index.rows(after.landmarks.id)
    np.testing.assert_allclose(after.p_G, before.p_G[rows], atol=1e-12)


def test_the_example_is_consistent():
    report = check_consistency(walk_map())
    assert report.errors == ()
    assert report.failure == ""


def test_removed_vertices_join_imu_and_odometry():
    m = walk_map()
    after, report = remove_vertices_counted(m, [3, 4, 5, 7])
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
    after, report = remove_vertices_counted(m, [1, 2])
    assert report.loop_closure_edges == 1
    assert report.absolute_poses == 1
    gone = np.isin(m.keypoint_vertex, [1, 2])
    assert report.observations == np.count_nonzero(gone & (m.keypoints.landmark >= 0))
    assert len(after.keypoints) == np.count_nonzero(~gone)


def test_an_edge_type_that_one_link_lacks_is_dropped():
    m = walk_map()
    m = m.replace(transformation_edges=m.transformation_edges.take(np.arange(1, 11)))
    after, report = remove_vertices_counted(m, [1])
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
    expected = composed_covariance(T_1[None], c_1[None], T_2[None], c_2[None])[0]
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
