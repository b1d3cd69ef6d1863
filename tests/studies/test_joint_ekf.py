"""The joint filter, a baseline: exact without noise, about as good as it says with it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.estimation.parameters import Parameters
from maplab_py.errors import EstimationError
from maplab_py.estimation.blocks import ParameterBlocks
from maplab_py.estimation.terms.cameras import EXTRINSICS, INTRINSICS
from maplab_py.geometry import se3
from maplab_py.sensors.sensor_set import Sensor
from maplab_py.storage.map_saving import save_map
from maplab_py.storage.native import load_map
from maplab_py.vimap import VIMap
from studies import ekf_tracks, joint_ekf
from studies.__main__ import main
from tests.algorithms.self_calibration.scenes import (
    OPTIONS,
    device,
    nominal,
    scene_map,
    uncalibrated,
)


def with_known_lens(truth: VIMap) -> VIMap:
    """Forget IMU calibration and mounting; intrinsics are given to a filter."""
    imu, rig = device(truth)
    wrong = nominal(truth)
    sensors: dict[str, Sensor] = {
        imu.id: wrong.imu(imu.id),
        rig.id: dataclasses.replace(rig, T_B_C=wrong.camera_rig(rig.id).T_B_C),
    }
    return truth.replace(sensors=dataclasses.replace(truth.sensors, sensors=sensors))


def error(truth: VIMap, result: joint_ekf.JointFilter) -> np.ndarray:
    true = filter_jointly_blocks(truth)
    return result.parameters.difference(result.blocks, true)


def filter_jointly_blocks(truth: VIMap) -> ParameterBlocks:
    """The blocks of the true sensors, as the filter lays them out."""
    from maplab_py.algorithms.vi_optimization.calibration_states import rig_cameras
    from maplab_py.estimation.terms.cameras import camera_blocks
    from maplab_py.estimation.terms.inertial_calibration import imu_blocks

    rig = rig_cameras(truth, np.arange(1))
    imu = truth.sensors.imu(device(truth)[0].id)
    return ParameterBlocks([*camera_blocks(rig.cameras, rig.timing_s[:, 0]), *imu_blocks((imu,))])


def test_without_noise_the_truth_is_a_fixed_point() -> None:
    result = joint_ekf.filter_jointly(scene_map(vertices=41), OPTIONS)
    assert np.abs(result.change).max() <= 1e-9
    assert result.tracks_used > 50
    assert result.tracks_rejected == 0


def test_without_noise_the_calibration_is_approached() -> None:
    truth = scene_map(vertices=121)
    start = with_known_lens(truth)
    result = joint_ekf.filter_jointly(start, OPTIONS)
    after = error(truth, result)
    sigma = np.sqrt(np.diag(result.covariance))
    assert np.abs(after / sigma).max() <= 0.5
    gyro = [k for k, name in enumerate(result.parameters.names) if "gyroscope x scale" in name]
    assert np.abs(after[gyro]).max() <= 1e-4
    assert result.blocks[INTRINSICS].values == pytest.approx(result.before[INTRINSICS].values)
    assert np.shape(result.changes) == (121, 21)
    report = result.report()
    assert len(report.parameters) == 21
    assert report.keyframes == 121


@pytest.mark.slow
def test_errors_are_about_as_large_as_announced() -> None:
    total, seeds = 0.0, 8
    for seed in range(1, seeds + 1):
        truth = scene_map(vertices=81, noise=1.0, seed=seed)
        result = joint_ekf.filter_jointly(with_known_lens(truth), OPTIONS)
        off = error(truth, result)
        total += float(off @ np.linalg.solve(result.covariance, off))
        assert result.mean_square == pytest.approx(1.0, abs=0.3)
    # filters linearise once: they promise somewhat too much
    assert 21 * 0.5 <= total / seeds <= 21 * 2.0


def test_derivatives_of_tracks() -> None:
    vi_map = scene_map(vertices=21)
    _, rig = device(vi_map)
    tracks = ekf_tracks.tracks_of(vi_map, np.arange(21), rig.cameras, joint_ekf.WINDOW)
    T_G_I, T_I_C = vi_map.T_G_I, rig.T_B_C
    chosen = np.arange(min(5, len(tracks.camera)))
    at = ekf_tracks.linearised(tracks, chosen, T_G_I, T_I_C, T_G_I)
    assert np.abs(at.residual).max() <= 1e-6
    # what points take up cannot be seen: compare after projecting on what they cannot
    step = 1e-6
    for column in range(6):
        delta = np.zeros((1, 6))
        delta[0, column] = step
        moved = ekf_tracks.linearised(tracks, chosen, T_G_I, se3.retract(T_I_C, delta), T_G_I)
        for one in range(len(chosen)):
            own = at.track == one
            points = at.by_point[own].reshape(-1, 3)
            across = np.eye(len(points)) - points @ np.linalg.pinv(points)
            expected = -across @ at.by_camera[own][:, :, column].reshape(-1)
            found = across @ (moved.residual[own] - at.residual[own]).reshape(-1) / step
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-2)


def test_intrinsics_alone_are_refused() -> None:
    options = dataclasses.replace(OPTIONS, states="intrinsics")
    with pytest.raises(EstimationError, match="neither intrinsics"):
        joint_ekf.filter_jointly(scene_map(vertices=21), options)


def test_only_what_is_asked_for_moves() -> None:
    truth = scene_map(vertices=61)
    options = dataclasses.replace(OPTIONS, states="extrinsics_rotation")
    result = joint_ekf.filter_jointly(with_known_lens(truth), options)
    assert isinstance(result.parameters, Parameters)
    assert len(result.parameters) == 3
    moved = result.blocks[EXTRINSICS].difference(result.before[EXTRINSICS].values)[0]
    assert np.abs(moved[:3]).max() <= 1e-12
    assert np.abs(moved[3:]).max() > 1e-4


def test_a_map_of_a_folder_is_calibrated_but_for_the_lens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_map(uncalibrated(scene_map(vertices=61, noise=1.0)), tmp_path / "walk")
    assert main(["joint_ekf", f"--map={tmp_path / 'walk'}", f"--out={tmp_path / 'result'}"]) == 0
    assert not [p for p in json.loads(capsys.readouterr().out)["parameters"] if "focal" in str(p)]
    before, after = (device(load_map(tmp_path / name)[0])[1] for name in ("walk", "result"))
    np.testing.assert_array_equal(after.cameras[0].intrinsics, before.cameras[0].intrinsics)
    assert np.abs(after.T_B_C - before.T_B_C).max() > 1e-5
