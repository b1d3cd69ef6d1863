"""Parts of a map: what they hold, and what comes back from their edits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.edits import merge_landmarks, with_p_G
from maplab_py.vimap.excerpts import cut_by_time, excerpt, mission_maps
from maplab_py.vimap.merge import merge_maps
from maplab_py.vimap.submaps import append_submaps
from tests.simulation.small import simulated


@pytest.fixture(scope="module")
def both() -> VIMap:
    first, second = simulated().maps
    return merge_maps(first, second)[0]


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


def test_submaps_cut_by_time_join_to_the_map_again() -> None:
    session = simulated().maps[0]
    submaps = cut_by_time(session, 2.0)
    assert len(submaps) == 3
    for a, b in itertools.pairwise(submaps):
        assert np.array_equal(a.vertices.id[-1], b.vertices.id[0])
    joined, report = append_submaps(submaps)
    assert report.vertices_shared == 2
    assert np.array_equal(joined.vertices.id, session.vertices.id)
    np.testing.assert_allclose(joined.vertices.T_M_I, session.vertices.T_M_I, atol=1e-9)
    assert len(joined.imu_samples) == len(session.imu_samples)
    observed = np.count_nonzero(np.diff(session.observation_start))
    assert len(joined.landmarks) == observed
    assert len(joined.observations) == len(session.observations)


def test_a_short_session_is_one_submap() -> None:
    session = simulated().maps[1]
    assert len(cut_by_time(session, 100.0)) == 1


def test_each_mission_becomes_a_map(both: VIMap) -> None:
    parts = mission_maps(both)
    assert [len(part.missions) for part in parts] == [1, 1]
    assert sum(len(part.vertices) for part in parts) == len(both.vertices)
