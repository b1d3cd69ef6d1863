"""Exports mean the same device: each format's own model is applied to motions and compared."""

import json

import numpy as np
import pytest
import yaml

from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.errors import UserError
from maplab_py.geometry import so3
from maplab_py.interop.calibration_export import (
    exported,
    lower_triangular,
    rotated_lower_triangular,
)
from maplab_py.sensors import Distortion
from tests.algorithms.self_calibration.scenes import INTRINSICS, scene_map
from tests.support.imu_model import distort_imu

FORCE_I, TURN_I, POINT_I = np.random.default_rng(3).normal(size=(3, 20, 3))
FORCE_I *= 5.0
POINT_I += np.array([4.0, 0.0, 0.0])
READINGS = distort_imu(
    INTRINSICS, np.concatenate([FORCE_I, TURN_I], axis=1), np.zeros(3), np.zeros(3)
)


def written(form: str, distortion: Distortion = Distortion.RADTAN) -> dict[str, str]:
    vi_map = scene_map(distortion=distortion)
    return exported(vi_map.sensors, *device_of(vi_map), form, imu_rate_hz=200.0)


def point_in_camera() -> np.ndarray:
    vi_map = scene_map(distortion=Distortion.RADTAN)
    T_I_C = vi_map.sensors.T_I_C(*device_of(vi_map))[0]
    return (POINT_I - T_I_C[4:]) @ so3.to_matrix(T_I_C[:4])


def test_triangular_factors() -> None:
    matrix = np.eye(3) + 0.1 * np.random.default_rng(4).normal(size=(3, 3))
    lower, rotation = lower_triangular(matrix)
    np.testing.assert_allclose(lower @ rotation, matrix, atol=1e-14)
    other, below = rotated_lower_triangular(matrix)
    np.testing.assert_allclose(other @ below, matrix, atol=1e-14)
    for triangle, turn in ((lower, rotation), (below, other)):
        np.testing.assert_allclose(np.triu(triangle, 1), 0.0, atol=1e-14)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(turn) == pytest.approx(1.0)


def test_kalibr_means_the_same() -> None:
    files = written("kalibr")
    imu = yaml.safe_load(files["imu.yaml"])["imu0"]
    camera = yaml.safe_load(files["camchain-imucam.yaml"])["cam0"]
    M_a = np.array(imu["accelerometers"]["M"])
    M_g, C = np.array(imu["gyroscopes"]["M"]), np.array(imu["gyroscopes"]["C_gyro_i"])
    np.testing.assert_allclose(np.triu(M_a, 1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.triu(M_g, 1), 0.0, atol=1e-12)
    # frame i is turned against I by what makes its accelerometer readings right
    R_i_I = np.linalg.solve(M_a, INTRINSICS.T_a @ INTRINSICS.R_A_I)
    np.testing.assert_allclose(R_i_I @ R_i_I.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(TURN_I @ R_i_I.T @ (M_g @ C).T, READINGS[:, 3:], atol=1e-9)
    T_cam_imu = np.array(camera["T_cam_imu"])
    p_C = POINT_I @ R_i_I.T @ T_cam_imu[:3, :3].T + T_cam_imu[:3, 3]
    np.testing.assert_allclose(p_C, point_in_camera(), atol=1e-9)


def test_openvins_means_the_same() -> None:
    files = written("openvins")
    assert all(text.startswith("%YAML:1.0\n") for text in files.values())
    imu = yaml.safe_load(files["kalibr_imu_chain.yaml"].split("\n", 1)[1])["imu0"]
    force = FORCE_I @ np.array(imu["R_IMUtoACC"]).T @ np.array(imu["Ta"]).T
    turn = TURN_I @ np.array(imu["R_IMUtoGYRO"]).T @ np.array(imu["Tw"]).T
    np.testing.assert_allclose(np.concatenate([force, turn], axis=1), READINGS, atol=1e-12)
    assert imu["model"] == "rpng"
    with pytest.raises(UserError, match="OpenVINS"):
        written("openvins", Distortion.FOV)


def test_basalt_means_the_same() -> None:
    content = json.loads(written("basalt")["calibration.json"])["value0"]
    a, g = content["calib_accel_bias"], content["calib_gyro_bias"]
    S_a = np.array([[a[3], 0, 0], [a[4], a[6], 0], [a[5], a[7], a[8]]])
    S_g = np.array(g[3:]).reshape(3, 3).T
    pose = content["T_imu_cam"][0]
    q = np.array([pose[k] for k in ("qx", "qy", "qz", "qw")])
    p = np.array([pose[k] for k in ("px", "py", "pz")])
    force_i = READINGS[:, :3] @ (np.eye(3) + S_a).T
    turn_i = READINGS[:, 3:] @ (np.eye(3) + S_g).T
    # both are true values in one frame i; find it from the forces
    R_i_I = np.linalg.lstsq(FORCE_I, force_i, rcond=None)[0].T
    np.testing.assert_allclose(R_i_I @ R_i_I.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(turn_i, TURN_I @ R_i_I.T, atol=1e-9)
    p_C = (POINT_I @ R_i_I.T - p) @ so3.to_matrix(q)
    np.testing.assert_allclose(p_C, point_in_camera(), atol=1e-9)
