from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.gates import rival_shares
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.geometry import se3
from tests.algorithms.loop_closure.rooms import Walk, make_map


def queries(p, way, inliers, *, far_own=None, mission=None):
    count = len(p)
    T = se3.identity(count)
    T[:, 4:] = p
    query = np.array([7, 7, 8][:count])
    mission = np.zeros(count, dtype=np.int64) if mission is None else np.asarray(mission)
    way = np.asarray(way, dtype=float)
    judgement = SimpleNamespace(
        vi_map=SimpleNamespace(missions=range(2)),
        query=query,
        T_M_I=T,
        missions=(mission, mission),
        way_m=(way, way),
        values=SimpleNamespace(inliers=np.asarray(inliers)),
        is_far=np.zeros(count, dtype=bool) if far_own is None else np.asarray(far_own),
        options=LoopClosureOptions(max_drift_ratio=0.1),
    )
    shares = rival_shares(judgement, np.ones(count, dtype=bool))
    return np.unique(query[shares >= 0.5]).tolist()


def test_two_far_places_of_one_mission_are_ambiguous():
    assert queries([[0, 0, 0], [9, 0, 0], [9, 0, 0]], [0, 20, 20], [50, 40, 40]) == [7]


def test_a_much_weaker_second_place_does_not_count():
    assert queries([[0, 0, 0], [9, 0, 0], [9, 0, 0]], [0, 20, 20], [50, 20, 40]) == []


def test_two_ends_of_a_drifting_loop_are_one_place():
    assert queries([[0, 0, 0], [1, 0, 0], [1, 0, 0]], [0, 60, 60], [50, 50, 50]) == []


def test_places_of_two_missions_say_nothing_about_each_other():
    assert queries([[0, 0, 0], [9, 0, 0]], [0, 20], [50, 50], mission=[0, 1]) == []


def test_a_far_place_of_the_own_mission_is_ambiguous():
    assert queries([[0, 0, 0]], [0], [30], far_own=[True]) == [7]
    assert queries([[0, 0, 0]], [0], [15], far_own=[True]) == []


# mission 0 was in a room, mission 1 in its twin, mission 2 in both, which are 9 m apart
TWINS = [
    Walk(room=1),
    Walk(room=1, mission=1, room_at=(0.0, 9.0, 0.0)),
    Walk(room=1, mission=2),
    Walk(room=1, mission=2, start_s=40.0, room_at=(0.0, 9.0, 0.0)),
]


def test_missions_in_rooms_that_look_alike_stay_unknown_with_the_reason():
    vi_map, _ = make_map(TWINS)
    for known in range(3):
        is_known = np.arange(3) == known
        one = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=is_known))
        anchored, report = anchor_missions(one)
        assert anchored.baseframes.is_known.tolist() == is_known.tolist()
        assert report.anchored == ()
        assert "look" in report.failure


def test_known_base_frames_tell_twins_apart():
    vi_map, truth = make_map(TWINS)
    merged, report = close_loops(vi_map)
    assert report.landmarks_merged > 100
    # landmarks of the two rooms stay apart: no landmark is seen from both
    side = truth[merged.keypoint_vertex[merged.observations], 5] > 4.5
    landmark = merged.keypoints.landmark[merged.observations]
    for row in np.unique(landmark):
        assert len(np.unique(side[landmark == row])) == 1
