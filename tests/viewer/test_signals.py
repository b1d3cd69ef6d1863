"""What is plotted along a mission."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.geometry import se3
from maplab_py.interop.trajectories import Trajectory
from maplab_py.sensors import SensorSet
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.playback import observation_signals, vertex_signals
from maplab_py.vimap import VIMap
from tests.vimap.builders import walk_map


def _titles(vi_map: VIMap, truth: Trajectory | None = None) -> dict[str, np.ndarray]:
    drawing = make_drawing(vi_map, VisualizationOptions())
    return {signal.title: signal.values for signal in vertex_signals(drawing, truth)}


def test_states_are_those_of_the_vertices() -> None:
    rng = np.random.default_rng(0)
    vi_map = walk_map()
    states = {name: rng.normal(size=(12, 3)) for name in ("v_M", "accel_bias", "gyro_bias")}
    signals = _titles(vi_map.replace(vertices=vi_map.vertices.replace(**states)))
    np.testing.assert_array_equal(signals["velocity"], states["v_M"])
    np.testing.assert_array_equal(signals["accelerometer bias"], states["accel_bias"])
    np.testing.assert_array_equal(signals["gyroscope bias"], states["gyro_bias"])
    without = {name: np.zeros((12, 3)) for name in states}
    signals = _titles(vi_map.replace(vertices=vi_map.vertices.replace(**without)))
    assert not {"velocity", "accelerometer bias", "gyroscope bias"} & set(signals)


def test_errors_and_counts_are_those_of_the_observations() -> None:
    vi_map = walk_map()
    uv_px = np.array(vi_map.keypoints.uv_px)
    observed = vi_map.keypoints.landmark >= 0
    uv_px[:, 0] += 3.0 * (vi_map.keypoint_vertex == 4)
    shifted = vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv_px))
    error_px, landmarks = observation_signals(shifted)
    np.testing.assert_allclose(error_px[4], 3.0, atol=1e-3)
    np.testing.assert_allclose(np.delete(error_px, 4), 0.0, atol=1e-3)
    expected = [
        len(np.unique(vi_map.keypoints.landmark[observed & (vi_map.keypoint_vertex == row)]))
        for row in range(12)
    ]
    np.testing.assert_array_equal(landmarks, expected)


def test_bad_landmarks_do_not_count_in_the_error() -> None:
    vi_map = walk_map()
    p_I, quality = np.array(vi_map.landmarks.p_I), np.array(vi_map.landmarks.quality)
    p_I[::5] += 0.4
    quality[::5] = 1
    table = vi_map.landmarks.replace(p_I=p_I, quality=quality)
    error_px, _ = observation_signals(vi_map.replace(landmarks=table))
    np.testing.assert_allclose(error_px, 0.0, atol=1e-3)


def test_without_calibrated_cameras_there_is_no_error() -> None:
    signals = _titles(walk_map().replace(sensors=SensorSet()))
    assert "reprojection error" not in signals
    assert "landmarks" in signals


def test_the_position_error_needs_truth() -> None:
    vi_map = walk_map()
    truth = Trajectory(
        vi_map.vertices.timestamp_ns[:-2], np.array(vi_map.T_G_I)[:-2], source="truth.csv"
    )
    assert "position error" not in _titles(vi_map)
    T = np.array(truth.T_R_B)
    T[3, 4:] += [0.0, 0.0, 0.5]
    error_m = _titles(vi_map, dataclasses.replace(truth, T_R_B=T))["position error"][:, 0]
    assert np.isnan(error_m[-2:]).all()
    assert int(np.nanargmax(error_m)) == 3
    assert error_m[3] == pytest.approx(0.5, abs=0.1)
    turned = se3.compose(se3.make([0.0, 0.0, 1.0, 0.0], [4.0, 5.0, 6.0]), truth.T_R_B)
    signals = _titles(vi_map, dataclasses.replace(truth, T_R_B=turned))
    assert "position error" in signals
    np.testing.assert_allclose(signals["position error"][:-2], 0.0, atol=1e-6)
