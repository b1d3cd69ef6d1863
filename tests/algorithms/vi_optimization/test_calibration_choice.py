"""optvi frees what of the calibration the residuals contradict, and nothing else."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.geometry import se3
from maplab_py.sensors import CameraRig
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import (
    CameraOptions,
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.vimap import VIMap

AUTO = VIOptimizationOptions(calibration="auto")
FIXED = VIOptimizationOptions()


def scenario(line_delay_s: float = 0.0) -> Scenario:
    return dataclasses.replace(
        Scenario().with_seed(1),
        sessions=(SessionOptions(duration_s=10.0),),
        world=WorldOptions(landmarks_per_room=800),
        measurement=MeasurementOptions(max_keypoints=150),
        cameras=(CameraOptions(line_delay_s=line_delay_s),),
    )


@pytest.fixture(scope="module")
def data() -> SimulatedData:
    return simulate(scenario())


def with_fault(vi_map: VIMap, fault: str) -> VIMap:
    """Return the map with a wrong calibration."""
    rig = next(s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig))
    camera, T_B_C = rig.cameras[0], rig.T_B_C
    if fault == "time_offset":
        camera = dataclasses.replace(camera, image_delay_s=camera.image_delay_s + 0.005)
    elif fault == "extrinsics_rotation":
        T_B_C = se3.retract(T_B_C, np.array([[0, 0, 0, 0.015, -0.01, 0.01]]))
    elif fault == "intrinsics":
        camera = dataclasses.replace(camera, intrinsics=camera.intrinsics * [1.02, 1.02, 1.0, 1.0])
    elif fault == "line_delay":
        camera = dataclasses.replace(camera, image_delay_s=0.0, line_delay_ns=0)
    rig = dataclasses.replace(rig, cameras=(camera,), T_B_C=T_B_C)
    sensors = {**vi_map.sensors.sensors, rig.id: rig}
    return vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))


def test_a_true_calibration_stays_to_the_last_bit(data: SimulatedData) -> None:
    result, report = optimize(data.maps[0], AUTO)
    wanted, _ = optimize(data.maps[0], FIXED)
    assert report.calibration == []
    assert "calibration" not in report.note
    np.testing.assert_array_equal(result.vertices.T_M_I, wanted.vertices.T_M_I)
    assert result.sensors is data.maps[0].sensors


@pytest.mark.parametrize(
    ("fault", "words", "block"),
    [
        ("time_offset", "image delay -", "image delay"),
        ("extrinsics_rotation", "rotation on the IMU", "rotation"),
        ("intrinsics", "focal length -", "fu"),
    ],
)
def test_a_fault_is_freed_named_and_mended(
    data: SimulatedData, fault: str, words: str, block: str
) -> None:
    start = with_fault(data.maps[0], fault)
    result, report = optimize(start, AUTO)
    free = {f"fix_ncamera_{fault}": False}  # the same from a true calibration
    wanted, _ = optimize(data.maps[0], dataclasses.replace(FIXED, **free))
    kept, _ = optimize(start, FIXED)
    truth = data.truth
    assert words in report.note
    assert "--ba_calibration=auto" in report.note
    assert any(block in row.parameter for row in report.calibration)
    assert all(np.isfinite(row.sigma) and row.sigma > 0.0 for row in report.calibration)
    of_truth_m = evaluate_map(wanted, truth).ate_m
    assert evaluate_map(result, truth).ate_m <= 1.1 * of_truth_m
    assert evaluate_map(kept, truth).ate_m > 1.3 * of_truth_m
    assert optimize(result, AUTO)[1].calibration == []


def test_a_rolling_shutter_is_found() -> None:
    data = simulate(scenario(30e-3 / 480))
    result, report = optimize(with_fault(data.maps[0], "line_delay"), AUTO)
    assert "line delay +6" in report.note
    rig = next(s for s in result.sensors.sensors.values() if isinstance(s, CameraRig))
    assert rig.cameras[0].line_delay_ns == pytest.approx(62_500, rel=0.1)


@pytest.mark.parametrize(
    "settings",
    [
        {"calibration": "fixed"},
        {"num_iterations": 3},
        {"fix_ncamera_line_delay": False},
        {"include_inertial": False},
        {"fix_landmark_positions": True},
    ],
)
def test_what_the_user_says_comes_first(data: SimulatedData, settings: dict[str, Any]) -> None:
    start = with_fault(data.maps[0], "time_offset")
    result, report = optimize(start, dataclasses.replace(AUTO, **settings))
    assert "contradict" not in report.note
    assert all("line delay" in row.parameter for row in report.calibration)
    rig = next(s for s in result.sensors.sensors.values() if isinstance(s, CameraRig))
    assert rig.cameras[0].image_delay_s == pytest.approx(0.005)
