import numpy as np
import pytest

from maplab_py.algorithms.keyframing.heuristic import Reason, choose_keyframes, keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.errors import FlagError
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.merge import merge_maps
from tests.vimap.builders import walk_map

LOOSE = {
    "distance_threshold_m": 1e3,
    "rotation_threshold_deg": 180.0,
    "every_nth_vertex": 1000,
    "min_shared_landmarks_obs": 0,
}


def test_each_heuristic_speaks_for_itself():
    m = walk_map()
    nth = choose_keyframes(m, KeyframingOptions(**{**LOOSE, "every_nth_vertex": 4}))
    # loop closures at 1 and 10, absolute poses at 2 and 9
    assert np.flatnonzero(nth == Reason.EVERY_NTH).tolist() == [6]
    assert np.flatnonzero(nth == Reason.LOOP_CLOSURE).tolist() == [1, 10]
    assert np.flatnonzero(nth == Reason.ABSOLUTE_POSE).tolist() == [2, 9]
    far = choose_keyframes(m, KeyframingOptions(**{**LOOSE, "distance_threshold_m": 0.65}))
    assert np.flatnonzero(far == Reason.DISTANCE).tolist() == [5, 8]
    few = choose_keyframes(m, KeyframingOptions(**{**LOOSE, "min_shared_landmarks_obs": 1000}))
    assert np.all(few[1:-1] == Reason.FEW_SHARED_LANDMARKS)
    turned = choose_keyframes(m, KeyframingOptions(**{**LOOSE, "rotation_threshold_deg": 3.0}))
    assert np.any(turned == Reason.ROTATION)


def test_keyframing_keeps_ends_and_chains_and_counts():
    m = walk_map()
    thin, report = keyframe(m, KeyframingOptions(**LOOSE))
    assert report.vertices_after == len(thin.vertices) == 6
    assert report.mission_ends == 2
    assert check_consistency(thin).errors == ()
    np.testing.assert_array_equal(thin.vertices.id[[0, -1]], m.vertices.id[[0, -1]])
    assert report.observations_removed == len(m.observations) - len(thin.observations)


def test_a_dry_run_changes_nothing():
    m = walk_map()
    same, report = keyframe(m, KeyframingOptions(**LOOSE), dry_run=True)
    assert same is m
    assert report.vertices_after == 6
    assert report.dry_run


def test_other_missions_are_left_alone():
    m, _ = merge_maps(walk_map(), walk_map(seed=1))
    thin, _ = keyframe(m, KeyframingOptions(**LOOSE), missions=np.array([1]))
    assert np.bincount(thin.vertices.mission).tolist() == [12, 6]


def test_bad_thresholds_are_refused():
    with pytest.raises(FlagError, match="every_nth"):
        KeyframingOptions(every_nth_vertex=0)
    with pytest.raises(FlagError, match="distance"):
        KeyframingOptions(distance_threshold_m=-1.0)
