from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.merging import Votes, unite
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.rooms import Walk, make_map

# three passes: every point has three landmarks in a row of keypoints of its own
THREE = [Walk(room=1, vertices=4, start_s=60.0 * i) for i in range(3)]


def landmarks_of_a_point(vi_map: VIMap) -> list[int]:
    """Return the landmarks, one of each pass, of a point that every pass sees four times."""
    lowest = np.where(np.diff(vi_map.observation_start) == 4)[0]
    position = np.round(vi_map.p_G[lowest], 6)
    for row in position:
        same = lowest[np.all(position == row, axis=1)]
        if len(same) == 3:
            return same.tolist()
    raise AssertionError("no point is seen by all passes")


def votes(*rows: tuple[int, int, int], doubtful: bool = False) -> Votes:
    first, second, query = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    bits = np.zeros(len(rows), dtype=np.int32)
    return Votes(first, second, query, bits, np.full(len(rows), doubtful))


def test_votes_for_landmarks_that_are_merged_are_votes_for_one():
    vi_map, _ = make_map(THREE)
    a, b, c = landmarks_of_a_point(vi_map)
    united = unite(vi_map, votes((a, b, 9), (a, b, 10), (a, c, 8), (b, c, 10)), 2)
    assert set(united.vote.tolist()) == {0, 1, 2, 3}
    assert united.too_few == united.seen_together == 0
    alone = unite(vi_map, votes((a, b, 9), (a, b, 10), (a, c, 8)), 2)
    assert set(alone.vote.tolist()) == {0, 1}
    assert alone.too_few == 1


def test_a_landmark_with_a_single_observer_needs_a_single_vote():
    vi_map, _ = make_map(THREE)
    a, b, _ = landmarks_of_a_point(vi_map)
    assert len(unite(vi_map, votes((a, b, 9)), 2).vote) == 0
    landmark = vi_map.keypoints.landmark.copy()
    landmark[np.flatnonzero(landmark == a)[1:]] = -1
    single = vi_map.replace(keypoints=vi_map.keypoints.replace(landmark=landmark))
    united = unite(single, votes((a, b, 9)), 2)
    assert united.vote.tolist() == [0]
    assert united.wanted.tolist() == [1]
    assert sorted([united.first[0], united.second[0]]) == sorted([a, b])


def test_doubtful_pairs_need_one_vote_more():
    vi_map, _ = make_map(THREE)
    a, b, _ = landmarks_of_a_point(vi_map)
    two, three = ((a, b, 9), (a, b, 10)), ((a, b, 8), (a, b, 9), (a, b, 10))
    assert len(unite(vi_map, votes(*two), 2).vote) == 2
    refused = unite(vi_map, votes(*two, doubtful=True), 2)
    assert len(refused.vote) == 0
    assert refused.too_few == 1
    united = unite(vi_map, votes(*three, doubtful=True), 2)
    assert united.wanted.tolist() == [3, 3, 3]


def test_two_landmarks_of_one_image_are_two_points():
    vi_map, _ = make_map(THREE)
    frame = vi_map.keypoint_frame
    a, b = vi_map.keypoints.landmark[np.flatnonzero(frame == 0)[:2]].tolist()
    united = unite(vi_map, votes((a, b, 5), (a, b, 6)), 2)
    assert len(united.vote) == 0
    assert united.seen_together == 1


def test_no_votes_unite_nothing():
    vi_map, _ = make_map(THREE[:1])
    united = unite(vi_map, votes(), 2)
    assert len(united.first) == united.too_few == united.seen_together == 0
