import dataclasses
import itertools

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.sensors import SensorSet
from maplab_py.vimap import VIMap, consistency, edits, merge, queries
from maplab_py.vimap.submaps import append_submap
from tests.support.data import shared_data
from tests.support.submaps import append_submaps
from tests.vimap.builders import RIG_ID, sensors, walk_map


def pieces(m: VIMap, borders: list[int]) -> list[VIMap]:
    """Cut a mission at vertices that both neighbours keep, as the submaps of the real maps."""
    cuts = [0, *borders, len(m.vertices) - 1]
    every = np.arange(len(m.vertices))
    return [
        edits.remove_vertices(m, (every < a) | (every > b)) for a, b in itertools.pairwise(cuts)
    ]


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [2, 1, 0]])
def test_pieces_of_a_mission_join_to_the_whole(order):
    whole = walk_map()
    parts = pieces(whole, [4, 8])
    joined, report = append_submaps([parts[i] for i in order])
    assert consistency.check_consistency(joined).errors == ()
    assert report.vertices_shared == 2
    assert report.landmarks_united == 0
    np.testing.assert_array_equal(joined.vertices.id, whole.vertices.id)
    np.testing.assert_array_equal(joined.imu_edges.id, whole.imu_edges.id)
    np.testing.assert_array_equal(joined.imu_samples.timestamp_ns, whole.imu_samples.timestamp_ns)
    assert len(joined.observations) == len(whole.observations)
    rows = whole.landmark_index.rows(joined.landmarks.id)
    np.testing.assert_allclose(joined.p_G, whole.p_G[rows], atol=1e-12)
    np.testing.assert_array_equal(rows[joined.keypoints.landmark], whole.keypoints.landmark)


def test_a_submap_may_come_before_what_is_there():
    whole = walk_map()
    first, second = pieces(whole, [5])
    joined, _ = append_submap(second, first)
    np.testing.assert_array_equal(joined.vertices.id, whole.vertices.id)
    assert joined.missions.root_vertex[0] == 0


def test_a_keypoint_unites_landmarks_of_different_ids():
    whole = walk_map()
    first, second = pieces(whole, [5])
    fresh = edits.with_new_ids(second).landmarks.id
    renamed = second.replace(landmarks=second.landmarks.replace(id=fresh))
    joined, report = append_submap(first, renamed)
    shared = whole.keypoints.landmark[whole.keypoint_vertex == 5]
    assert report.landmarks_with_equal_ids == 0
    assert report.landmarks_united == len(np.unique(shared))
    assert report.observations_united == len(shared)
    assert len(joined.observations) == len(whole.observations)
    assert consistency.check_consistency(joined).errors == ()


def test_a_submap_that_moved_is_laid_on_the_shared_vertex():
    whole = walk_map()
    first, second = pieces(whole, [5])
    T_N_M = se3.make(so3.exp([0.0, 0.0, 0.7]), [3.0, -2.0, 1.0])
    joined, report = append_submap(first, edits.transform_mission(second, 0, T_N_M))
    np.testing.assert_allclose(joined.vertices.T_M_I, whole.vertices.T_M_I, atol=1e-12)
    np.testing.assert_allclose(joined.vertices.v_M, whole.vertices.v_M, atol=1e-12)
    assert report.largest_yaw_deg == pytest.approx(np.rad2deg(0.7))


def test_pieces_that_do_not_touch_are_refused():
    first, _, third = pieces(walk_map(), [4, 8])
    with pytest.raises(MapError, match="shares no vertex"):
        append_submap(first, third)


def test_another_mission_is_refused():
    with pytest.raises(MapError, match="no mission"):
        append_submap(walk_map(), walk_map(seed=1))


def test_equal_ids_do_not_merge_without_new_ones():
    m = walk_map()
    with pytest.raises(MapError, match="--assign_new_ids"):
        merge.merge_maps(m, m)
    twice, report = merge.merge_maps(m, m, assign_new_ids=True)
    thrice, _ = merge.merge_maps(twice, m, assign_new_ids=True)
    assert len(thrice.missions) == 3
    assert report.assigned_new_ids
    assert consistency.check_consistency(thrice).errors == ()
    assert queries.mission_clusters(thrice).tolist() == [0, 1, 2]


def test_missions_with_a_common_landmark_are_one_cluster():
    m = walk_map()
    twice, _ = merge.merge_maps(m, m, assign_new_ids=True)
    bound = edits.merge_landmarks(twice, [len(m.landmarks)], [0])
    assert queries.mission_clusters(bound).tolist() == [0, 0]


def test_a_different_calibration_is_kept_under_a_new_id():
    base, other = walk_map(), walk_map(seed=1)
    same, report = merge.merge_maps(base, other)
    assert RIG_ID in report.sensors_shared
    assert len(same.sensors.sensors) == len(base.sensors.sensors)
    changed: SensorSet = sensors(focal_px=310.0)
    merged, report = merge.merge_maps(base, dataclasses.replace(other, sensors=changed))
    ((old, new),) = report.sensors_renamed
    assert old == RIG_ID
    assert merged.sensors.camera_rig(RIG_ID).cameras[0].intrinsics[0] == 300.0
    assert merged.sensors.camera_rig(new).cameras[0].intrinsics[0] == 310.0
    assert consistency.check_consistency(merged).errors == ()


def test_the_euroc_submaps_are_one_mission():
    from maplab_py.storage.native import load_map

    folder = shared_data("maplab_maps/euroc_v1_01")
    submaps = [load_map(folder / f"euroc_v1_01_submap_{i}")[0] for i in (3, 0, 7, 1, 2, 6, 5, 4)]
    joined, report = append_submaps(submaps)
    assert consistency.check_consistency(joined).errors == ()
    assert (len(joined.missions), len(joined.vertices)) == (1, 152)
    assert report.landmarks_with_equal_ids == 234
    assert report.landmarks_united == 2990
    thinned = edits.remove_vertices(joined, np.arange(1, 151, 2))
    assert consistency.check_consistency(thinned).errors == ()
    np.testing.assert_array_equal(
        np.unique(thinned.imu_samples.timestamp_ns), np.unique(joined.imu_samples.timestamp_ns)
    )
