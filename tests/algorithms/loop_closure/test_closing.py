"""Closing of loops between simulated sessions, and landmarks that become one."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.landmarks.keypoint_rays import landmark_covariance
from maplab_py.algorithms.loop_closure import merging
from maplab_py.algorithms.loop_closure.merging import Votes, compare_landmarks, unite
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, insert_edges, search_loops
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.sensors.projection import project
from maplab_py.vimap import LandmarkQuality, LoopClosureEdges, VIMap
from maplab_py.vimap.descriptors import no_blocks
from tests.algorithms.loop_closure.rooms import CAMERA, T_I_C, Walk, make_map

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]
UNRELATED = [Walk(room=1), Walk(room=2, start_s=60.0)]


def relative_errors(truth, edges):
    expected = se3.relative(truth[edges.from_vertex], truth[edges.to_vertex])
    turn = so3.log(so3.multiply(so3.inverse(expected[:, :4]), edges.T_A_B[:, :4]))
    position = np.linalg.norm(expected[:, 4:] - edges.T_A_B[:, 4:], axis=1)
    return position, np.degrees(np.linalg.norm(turn, axis=1))


def test_a_place_seen_twice_gives_true_edges():
    vi_map, truth = make_map(TWICE)
    search, report = search_loops(vi_map)
    edges = search.edges
    assert report.failure == ""
    assert report.accepted_vertices >= 22
    position, turn_deg = relative_errors(truth, edges)
    assert position.max() < 0.06
    assert turn_deg.max() < 0.6
    assert report.median_correction_m == pytest.approx(0.23, abs=0.06)
    mission_time = vi_map.vertices.timestamp_ns
    apart = np.abs(mission_time[edges.from_vertex] - mission_time[edges.to_vertex])
    assert apart.min() >= 10e9
    assert np.all(np.linalg.eigvalsh(edges.covariance) > 0.0)


def test_merging_unites_the_two_landmarks_of_a_point():
    vi_map, _ = make_map(TWICE)
    merged, report = close_loops(vi_map)
    assert report.failure == ""
    assert report.landmarks_merged > 150
    assert len(merged.landmarks) == len(vi_map.landmarks) - report.landmarks_merged
    # every keypoint keeps an observation, and no frame holds a landmark twice
    observed = merged.keypoints.landmark >= 0
    assert observed.all()
    pairs = np.stack([merged.keypoint_frame, merged.keypoints.landmark], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    # the input is untouched
    assert len(vi_map.landmarks) == len(make_map(TWICE)[0].landmarks)


def test_merged_landmarks_are_the_same_point():
    vi_map, _ = make_map(TWICE)
    merged, _ = close_loops(vi_map)
    from tests.algorithms.loop_closure.rooms import room_points

    descriptors = room_points(1)[1]
    bits = np.unpackbits(vi_map.keypoints.descriptor, axis=1).astype(np.int16)
    reference = np.unpackbits(descriptors, axis=1).astype(np.int16)
    point = np.argmin(
        bits.sum(1)[:, None] + reference.sum(1)[None] - 2 * bits @ reference.T, axis=1
    )
    for landmark in range(len(merged.landmarks)):
        assert len(np.unique(point[merged.keypoints.landmark == landmark])) == 1


def test_unrelated_places_are_not_closed_and_the_report_says_why():
    vi_map, _ = make_map(UNRELATED)
    closed, report = close_loops(vi_map)
    assert report.accepted == 0
    assert report.failure == ""  # an open path has no loops
    assert "no loop closures" in report.reason
    assert "needed" in report.reason or "--lc_min_verify_matches_num" in report.reason
    assert len(closed.landmarks) == len(vi_map.landmarks)


def test_a_loop_that_is_far_from_closed_is_refused_with_the_remedy():
    far = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.8, 0.1, 0.0, 0.02))]
    options = LoopClosureOptions(max_drift_ratio=1.0)
    vi_map, _ = make_map(far)
    closed, report = close_loops(vi_map, options)
    assert report.accepted > 0
    assert "run relax first" in report.failure
    assert len(closed.landmarks) == len(vi_map.landmarks)


def test_a_correction_beyond_any_drift_is_implausible():
    twin = [Walk(room=1), Walk(room=1, start_s=60.0, room_at=(0.0, 20.0, 0.0))]
    vi_map, _ = make_map(twin)
    _, report = close_loops(vi_map, LoopClosureOptions())
    assert report.accepted == 0
    assert "exceeds plausible drift" in report.refused


def test_other_missions_need_known_base_frames_to_merge():
    walks = [Walk(room=1), Walk(room=1, mission=1, drift=(0.1, 0.0, 0.0, 0.0))]
    vi_map, _ = make_map(walks)
    _, report = close_loops(vi_map)
    assert report.landmarks_merged > 150
    frames = vi_map.baseframes.replace(is_known=np.array([True, False]))
    _, refused = close_loops(vi_map.replace(baseframes=frames))
    assert refused.landmarks_merged == 0
    assert "anchor first" in refused.failure


def test_unknown_quality_is_evaluated_and_told():
    vi_map, _ = make_map(TWICE)
    quality = np.full(len(vi_map.landmarks), LandmarkQuality.UNKNOWN)
    unjudged = vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality))
    merged, report = close_loops(unjudged)
    assert "evaluated the quality" in report.notes[0]
    assert not np.any(merged.landmarks.quality == LandmarkQuality.UNKNOWN)


def test_edges_are_added_to_those_of_the_map_but_none_twice():
    vi_map, _ = make_map(TWICE)
    own = LoopClosureEdges.filled(1, id=[[7, 7]], from_vertex=[0], to_vertex=[20])
    once, report = insert_edges(vi_map.replace(loop_closure_edges=own))
    assert len(once.loop_closure_edges) == 1 + report.edges_added > 1
    assert len(once.landmarks) == len(vi_map.landmarks)
    twice, _ = insert_edges(once)
    np.testing.assert_array_equal(twice.loop_closure_edges.id, once.loop_closure_edges.id)
    assert twice.loop_closure_edges.from_vertex[0] == 0


def test_small_gaps_get_edges_unless_the_flag_forbids():
    vi_map, _ = make_map(TWICE)
    search, report = search_loops(vi_map, LoopClosureOptions(edge_min_distance_meters=1.0))
    edges = search.edges
    assert len(edges) == 0
    assert "--lc_edge_min_distance_meters=1" in report.failure


def test_covariance_scaler_and_switch_variance_reach_the_edges():
    vi_map, _ = make_map(TWICE)
    other = LoopClosureOptions(edge_covariance_scaler=4.0, switch_variable_variance=0.5)
    plain, scaled = (search_loops(vi_map, o)[0].edges for o in (LoopClosureOptions(), other))
    np.testing.assert_allclose(scaled.covariance, 4.0 * plain.covariance)
    assert np.all(scaled.switch_variable_variance == 0.5)
    assert np.all(scaled.switch_variable == 1.0)


def test_same_call_same_bytes_and_closed_loops_stay_closed():
    vi_map, _ = make_map(TWICE)
    first, report = close_loops(vi_map)
    second, _ = close_loops(vi_map)
    assert first.keypoints.landmark.tobytes() == second.keypoints.landmark.tobytes()
    again, repeated = close_loops(first)
    assert len(again.landmarks) >= len(first.landmarks) - report.landmarks_merged // 10
    assert repeated.accepted > 0 or "merged landmarks" in repeated.reason


def test_a_map_without_descriptors_is_refused():
    vi_map, _ = make_map(TWICE)
    frames = vi_map.frames.replace(descriptor_blocks=no_blocks(len(vi_map.frames)))
    with pytest.raises(EstimationError, match="no descriptors"):
        close_loops(vi_map.replace(frames=frames))


def test_stricter_gates_refuse():
    vi_map, _ = make_map(TWICE)
    for gate, reason in (
        ({"min_inlier_count": 1000}, "too few inliers"),
        ({"min_inlier_ratio": 1.01}, "inlier ratio too low"),
        ({"max_rotation_sigma_deg": 1e-4}, "rotation too uncertain"),
        ({"max_delta_position_m": 0.01}, "exceeds plausible drift"),
        ({"min_support": 1000}, "no closures nearby agree"),
    ):
        options = dataclasses.replace(LoopClosureOptions(), **gate)
        _, report = search_loops(vi_map, options)
        assert report.accepted == 0
        assert reason in report.refused
        assert reason in report.reason


NO_DRIFT = [Walk(room=1), Walk(room=1, start_s=60.0)]
OPTIONS = LoopClosureOptions()


def matches(vi_map):
    """Return the accepted closures and, for each of their matches, its closure and two landmarks."""
    closures = search_loops(vi_map)[0].closures
    closures = closures.take(np.flatnonzero(closures.accepted))
    closure = np.repeat(np.arange(len(closures)), np.diff(closures.start))
    return closures, closure, vi_map.keypoints.landmark[closures.keypoint].astype(np.int64)


def test_covariances_are_those_of_least_squares_over_the_keypoints():
    vi_map, _ = make_map(NO_DRIFT)
    landmarks = np.array([3, 40, 117])
    sigma_px, step = 1.5, 1e-5
    for landmark, covariance in zip(
        landmarks, landmark_covariance(vi_map, landmarks, sigma_px), strict=True
    ):
        keypoints = np.flatnonzero(vi_map.keypoints.landmark == landmark)
        T_C_G = se3.inverse(se3.compose(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints]], T_I_C))
        J = np.empty((len(keypoints), 2, 3))
        for axis in range(3):
            move = step * np.eye(3)[axis]
            ahead, back = (
                project(CAMERA, se3.transform(T_C_G, vi_map.p_G[landmark] + sign * move))[0]
                for sign in (1.0, -1.0)
            )
            J[:, :, axis] = (ahead - back) / (2.0 * step)
        expected = np.linalg.inv(np.einsum("nia,nib->ab", J, J) / sigma_px**2)
        # a ray's error is taken as round in angle, the image's as round in pixels
        ratio = np.linalg.eigvals(np.linalg.solve(expected, covariance)).real
        assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_distances_of_one_point_are_as_large_as_the_noise_says(monkeypatch):
    monkeypatch.setattr(merging, "_POSE_DRIFT", 0.0)  # poses are exact here
    vi_map, _ = make_map(NO_DRIFT, noise_px=1.0)
    rng = np.random.default_rng(5)
    covariance = landmark_covariance(vi_map, np.arange(len(vi_map.landmarks)), 1.0)
    noise = np.einsum(
        "nij,nj->ni", np.linalg.cholesky(covariance), rng.normal(size=(len(covariance), 3))
    )
    disturbed = moved(vi_map, noise)
    closures, closure, source = matches(disturbed)
    found = compare_landmarks(disturbed, closures, closure, source, closures.landmark, 1.0)
    assert 1.9 < np.median(found.squared_sigmas) < 2.9  # three degrees of freedom: 2.37
    assert np.mean(found.squared_sigmas > 16.0) < 0.01


def moved(vi_map: VIMap, shift_G: np.ndarray) -> VIMap:
    """Return the map with its landmarks moved by (L, 3)."""
    T_I_G = se3.inverse(vi_map.T_G_I[vi_map.landmarks.vertex])
    p_I = se3.transform(T_I_G, vi_map.p_G + shift_G)
    return vi_map.replace(landmarks=vi_map.landmarks.replace(p_I=p_I))


def test_landmarks_that_their_rays_keep_apart_are_not_merged():
    vi_map, _ = make_map(NO_DRIFT)
    closures, _, source = matches(vi_map)
    rows, votes = np.unique(source, return_counts=True)
    chosen = rows[votes >= 4][:10]
    shift = np.zeros((len(vi_map.landmarks), 3))
    shift[chosen, 2] = 0.28  # 3 degrees aside of where their keypoints see them
    tampered = moved(vi_map, shift)
    far = dataclasses.replace(OPTIONS, max_merge_sigma=1e6)
    _, before = merging.merge_verified_landmarks(tampered, closures, far)
    merged, now = merging.merge_verified_landmarks(tampered, closures, OPTIONS)
    assert np.isin(chosen, np.union1d(before.first, before.second)).all()
    assert not np.isin(chosen, np.union1d(now.first, now.second)).any()
    assert now.refused[merging.UNLIKELY] >= len(chosen)
    assert merging.UNLIKELY not in before.refused
    assert len(vi_map.landmarks) - len(merged.landmarks) == now.landmarks_merged
    assert now.landmarks_merged == before.landmarks_merged - len(chosen)


@pytest.mark.parametrize("sigma", [0.05, 4.0])
def test_the_report_says_how_many_were_refused(sigma):
    vi_map, _ = make_map(NO_DRIFT, noise_px=1.0)
    _, report = close_loops(vi_map, dataclasses.replace(OPTIONS, max_merge_sigma=sigma))
    assert (report.merges_refused.get(merging.UNLIKELY, 0) > 20) == (sigma < 1.0)


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
