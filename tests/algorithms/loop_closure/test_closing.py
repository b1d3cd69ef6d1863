from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops, find_loop_closures, insert_edges
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.vimap import LandmarkQuality, LoopClosureEdges
from maplab_py.vimap.descriptors import no_blocks
from tests.algorithms.loop_closure.rooms import Walk, make_map

TWICE = [Walk(room=1), Walk(room=1, start_s=60.0, drift=(0.2, -0.1, 0.05, 0.01))]
UNRELATED = [Walk(room=1), Walk(room=2, start_s=60.0)]


def relative_errors(truth, edges):
    expected = se3.relative(truth[edges.from_vertex], truth[edges.to_vertex])
    turn = so3.log(so3.multiply(so3.inverse(expected[:, :4]), edges.T_A_B[:, :4]))
    position = np.linalg.norm(expected[:, 4:] - edges.T_A_B[:, 4:], axis=1)
    return position, np.degrees(np.linalg.norm(turn, axis=1))


def test_a_place_seen_twice_gives_true_edges():
    vi_map, truth = make_map(TWICE)
    edges, report = find_loop_closures(vi_map)
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
    edges, report = find_loop_closures(vi_map, LoopClosureOptions(edge_min_distance_meters=1.0))
    assert len(edges) == 0
    assert "--lc_edge_min_distance_meters=1" in report.failure


def test_covariance_scaler_and_switch_variance_reach_the_edges():
    vi_map, _ = make_map(TWICE)
    plain, _ = find_loop_closures(vi_map, LoopClosureOptions())
    scaled, _ = find_loop_closures(
        vi_map, LoopClosureOptions(edge_covariance_scaler=4.0, switch_variable_variance=0.5)
    )
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
        _, report = find_loop_closures(vi_map, options)
        assert report.accepted == 0
        assert reason in report.refused
        assert reason in report.reason
