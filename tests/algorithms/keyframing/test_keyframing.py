"""Choice of keyframes, and inertial edges that predict the same before and after they are merged."""

import dataclasses
import time

import numpy as np
import pytest

from maplab_py.algorithms.keyframing.heuristic import Reason, choose_keyframes, keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.estimation.imu import inertial_data, preintegration
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import AbsolutePoses, IdIndex, LoopClosureEdges, VIMap, consistency, merge
from tests.simulation.small import simulated
from tests.support.machine import slowness
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
    assert consistency.check_consistency(thin).errors == ()
    np.testing.assert_array_equal(thin.vertices.id[[0, -1]], m.vertices.id[[0, -1]])
    assert report.observations_removed == len(m.observations) - len(thin.observations)


def test_other_missions_are_left_alone():
    m, _ = merge.merge_maps(walk_map(), walk_map(seed=1))
    thin, _ = keyframe(m, KeyframingOptions(**LOOSE), missions=np.array([1]))
    assert np.bincount(thin.vertices.mission).tolist() == [12, 6]


def straight_map(step_m=0.25, turn_deg=0.0):
    """Return a walk whose vertices are exactly as far apart as is said."""
    m = walk_map()
    steps = np.arange(len(m.vertices))
    turn = np.deg2rad(turn_deg) * steps[:, None] * [0.0, 0.0, 1.0]
    T_M_I = se3.make(so3.exp(turn), steps[:, None] * [step_m, 0.0, 0.0])
    return m.replace(
        vertices=m.vertices.replace(T_M_I=T_M_I),
        loop_closure_edges=LoopClosureEdges.empty(),
        absolute_poses=AbsolutePoses.empty(),
    )


def test_distances_of_exactly_the_threshold_are_not_enough():
    # multiples of 0.25 m are exact in floating point: 0.75 m is reached at the third vertex
    chosen = choose_keyframes(
        straight_map(), KeyframingOptions(**{**LOOSE, "distance_threshold_m": 0.75})
    )
    assert np.flatnonzero(chosen == Reason.DISTANCE).tolist() == [4, 8]


def test_rotations_of_exactly_the_threshold_are_not_enough():
    turned = straight_map(step_m=0.0, turn_deg=3.0)
    T = turned.vertices.T_M_I
    exact_deg = float(np.rad2deg(np.linalg.norm(se3.local(T[0], T[2])[3:])))
    chosen = choose_keyframes(
        turned, KeyframingOptions(**{**LOOSE, "rotation_threshold_deg": exact_deg})
    )
    assert np.flatnonzero(chosen == Reason.ROTATION)[0] == 3


def test_as_many_shared_landmarks_as_wanted_are_enough():
    m = straight_map()
    observed = [
        set(m.keypoints.landmark[(m.keypoint_vertex == row) & (m.keypoints.landmark >= 0)])
        for row in (0, 1)
    ]
    shared = len(observed[0] & observed[1])
    assert shared > 0
    for wanted, reason in ((shared, Reason.NONE), (shared + 1, Reason.FEW_SHARED_LANDMARKS)):
        options = KeyframingOptions(**{**LOOSE, "min_shared_landmarks_obs": wanted})
        assert choose_keyframes(m, options)[1] == reason


GRAVITY = np.array([0.0, 0.0, -9.81])


def inertial(vi_map: VIMap, edges: slice) -> inertial_data.InertialData:
    start = vi_map.sample_start
    rows = slice(start[edges.start], start[edges.stop])
    count = edges.stop - edges.start
    return inertial_data.InertialData(
        start[edges.start : edges.stop + 1] - start[edges.start],
        vi_map.imu_samples.timestamp_ns[rows],
        np.ascontiguousarray(vi_map.imu_samples.accel_gyro[rows]),
        (Imu("0" * 32),),
        np.zeros(count, dtype=np.int64),
    )


def largest_difference(before: VIMap, after: VIMap) -> tuple[float, float]:
    """Predict over every merged edge at once, and edge by edge before the merge."""
    v = after.vertices
    first = IdIndex(before.vertices.id).rows(v.id)
    biases = v.gyro_bias[:-1], v.accel_bias[:-1]
    count = len(after.imu_edges)
    assert count == len(v) - 1
    T, speed = preintegration.propagate(
        inertial(after, slice(0, count)), v.T_M_I[:-1], v.v_M[:-1], *biases, GRAVITY
    )
    last = after.sample_start[1:] - 1
    position, rotation = 0.0, 0.0
    for edge in range(count):
        T_M_I, v_M = v.T_M_I[edge][None], v.v_M[edge][None]
        for small in range(int(first[edge]), int(first[edge + 1])):
            data = inertial(before, slice(small, small + 1))
            poses, speeds = preintegration.propagate(
                data, T_M_I, v_M, v.gyro_bias[edge], v.accel_bias[edge], GRAVITY
            )
            T_M_I, v_M = poses[-1:], speeds[-1:]
        step = se3.local(T_M_I[0], T[last[edge]])
        position = max(position, float(np.abs(step[:3]).max()))
        position = max(position, float(np.abs(v_M[0] - speed[last[edge]]).max()))
        rotation = max(rotation, float(np.abs(step[3:]).max()))
    return position, rotation


def test_merged_edges_predict_what_the_single_ones_did():
    before = simulated().maps[0]
    after, report = keyframe(before, KeyframingOptions())
    assert report.vertices_after < report.vertices_before
    position, rotation = largest_difference(before, after)
    assert position < 1e-9
    assert rotation < 1e-9


def ten_minutes() -> VIMap:
    """Return a map of ten minutes at 10 Hz, with 200 Hz of inertial samples."""
    scenario = Scenario(
        measurement=MeasurementOptions(frame_rate_hz=10.0, max_keypoints=40),
        sessions=(SessionOptions(duration_s=600.0, turns=12.0),),
    )
    scenario = dataclasses.replace(
        scenario, world=dataclasses.replace(scenario.world, landmarks_per_room=600)
    )
    return simulate(scenario).maps[0]


@pytest.mark.slow
def test_ten_minutes_at_ten_hertz():
    before = ten_minutes()
    assert len(before.vertices) == 6001
    begin = time.process_time()
    after, report = keyframe(before, KeyframingOptions(min_shared_landmarks_obs=5))
    seconds = time.process_time() - begin
    assert report.vertices_after < 2000
    assert consistency.check_consistency(after).errors == ()
    position, rotation = largest_difference(before, after)
    assert position < 1e-9
    assert rotation < 1e-9
    assert seconds < 2.0 * slowness()
