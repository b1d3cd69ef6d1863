"""Corrected samples against integrals that are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.calibration import calibrate
from maplab_py.algorithms.self_calibration.estimation.imu_interpolation import (
    correct_interpolation_bias,
)
from maplab_py.algorithms.self_calibration.estimation.problem import build_segment_problem
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.simulation.scenario import MotionOptions, SessionOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.simulation.truth import true_map
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows
from tests.algorithms.self_calibration.scenes import scene_map
from tests.support.noiseless import without_noise


def with_signal(vi_map: VIMap, hertz: float) -> tuple[VIMap, np.ndarray]:
    """Put a sine on all axes; return the integral (E,) over every edge, too."""
    time = vi_map.imu_samples.timestamp_ns * 1e-9
    begin = time.min()
    omega = 2.0 * np.pi * hertz
    values = np.repeat(np.sin(omega * (time - begin))[:, None], 6, axis=1)
    first = vi_map.sample_start[:-1]
    last = vi_map.sample_start[1:] - 1
    true = (np.cos(omega * (time[first] - begin)) - np.cos(omega * (time[last] - begin))) / omega
    return vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=values)), true


def integrals(vi_map: VIMap) -> np.ndarray:
    """Integrate straight lines between samples over every edge (E,)."""
    time, values = vi_map.imu_samples.timestamp_ns * 1e-9, vi_map.imu_samples.accel_gyro[:, 3]
    result = []
    for edge in range(len(vi_map.imu_edges)):
        rows = ragged_rows(vi_map.sample_start, np.array([edge]))
        result.append(np.trapezoid(values[rows], time[rows]))
    return np.array(result)


def test_chords_integrate_like_the_curve() -> None:
    vi_map, true = with_signal(scene_map(), 1.5)
    inner = slice(1, -1)  # at the ends the curvature is that of the neighbour
    plain = np.abs(integrals(vi_map) - true)[inner].max()
    corrected = np.abs(integrals(correct_interpolation_bias(vi_map)) - true)[inner].max()
    assert corrected < 0.01 * plain


def test_straight_signals_stay() -> None:
    vi_map = scene_map()
    time = vi_map.imu_samples.timestamp_ns * 1e-9
    straight = np.repeat((0.3 + 0.2 * (time - time.min()))[:, None], 6, axis=1)
    before = vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=straight))
    after = correct_interpolation_bias(before).imu_samples.accel_gyro
    np.testing.assert_allclose(after, straight, atol=1e-9)


def test_copies_of_a_sample_between_edges_stay_equal() -> None:
    vi_map, _ = with_signal(scene_map(), 1.5)
    corrected = correct_interpolation_bias(vi_map)
    values, start = corrected.imu_samples.accel_gyro, corrected.sample_start
    follows = vi_map.imu_edges.to_vertex[:-1] == vi_map.imu_edges.from_vertex[1:]
    assert follows.any()
    np.testing.assert_array_equal(values[start[1:-1] - 1][follows], values[start[1:-1]][follows])


@pytest.mark.slow
def test_a_shaken_imu_keeps_its_scale() -> None:
    """Perfect measurements at 100 Hz: what is left is the error of the integration."""
    scenario = load_scenario("ar_room")
    motion = MotionOptions(
        kind="figure_8",
        duration_s=10.0,
        turns=0.3,
        wall_distance_m=2.6,
        shake_m=0.06,
        shake_rad=0.2,
    )
    perfect = dataclasses.replace(
        without_noise(scenario),
        calibration=scenario.calibration,
        sessions=(SessionOptions(phases=(motion,)),),
    )
    data = simulate(perfect)
    true = true_map(data.maps[0], data.truth)
    errors = []
    for curvature in (False, True):
        options = SelfCalibrationOptions(
            keep_unobservable_at_prior=True, imu_curvature=curvature, loss="none"
        )
        blocks = build_segment_problem(true, options, robust=False).states.blocks
        result, _ = calibrate(true, options)
        error = result.parameters.difference(result.blocks, blocks)
        errors.append(np.abs(error[:3]).max())  # scales of the gyroscope
    assert errors[0] > 2e-4
    assert errors[1] < 0.25 * errors[0]
