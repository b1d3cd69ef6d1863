"""What inertial edges predict is the same before and after keyframing merges them."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.propagation import propagate
from maplab_py.geometry import se3
from maplab_py.sensors import Imu
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.ids import IdIndex
from tests.simulation.small import simulated
from tests.support.machine import slowness

GRAVITY = np.array([0.0, 0.0, -9.81])


def inertial(vi_map: VIMap, edges: slice) -> InertialData:
    start = vi_map.sample_start
    rows = slice(start[edges.start], start[edges.stop])
    count = edges.stop - edges.start
    return InertialData(
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
    T, speed = propagate(
        inertial(after, slice(0, count)), v.T_M_I[:-1], v.v_M[:-1], *biases, GRAVITY
    )
    last = after.sample_start[1:] - 1
    position, rotation = 0.0, 0.0
    for edge in range(count):
        T_M_I, v_M = v.T_M_I[edge][None], v.v_M[edge][None]
        for small in range(int(first[edge]), int(first[edge + 1])):
            data = inertial(before, slice(small, small + 1))
            poses, speeds = propagate(
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
    assert check_consistency(after).errors == ()
    position, rotation = largest_difference(before, after)
    assert position < 1e-9
    assert rotation < 1e-9
    assert seconds < 2.0 * slowness()
