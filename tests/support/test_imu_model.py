"""The IMU model and its inverse."""

from __future__ import annotations

import numpy as np

from maplab_py.geometry import so3
from maplab_py.sensors import ImuIntrinsics
from tests.support.imu_model import correct_imu, distort_imu


def test_the_equations() -> None:
    rng = np.random.default_rng(1)
    T_g, T_a = (np.eye(3) + np.triu(rng.normal(size=(3, 3))) * 0.02 for _ in range(2))
    R_A_I = so3.to_matrix(so3.exp(rng.normal(size=3)))
    b_a, b_g, f, w = rng.normal(size=(4, 3))
    out = distort_imu(ImuIntrinsics(T_g, T_a, R_A_I), np.concatenate([f, w]), b_a, b_g)
    assert np.allclose(out[:3], T_a @ (R_A_I @ f) + b_a)
    assert np.allclose(out[3:], T_g @ w + b_g)


def test_correction_inverts_and_batches() -> None:
    rng = np.random.default_rng(2)
    T = np.eye(3) + np.triu(rng.normal(size=(3, 3))) * 0.02
    R_A_I = so3.to_matrix(so3.exp(rng.normal(size=3)))
    values, biases = rng.normal(size=(4, 5, 6)), rng.normal(size=(2, 4, 1, 3))
    for intrinsics in (None, ImuIntrinsics(T, T.copy(), R_A_I)):
        reported = distort_imu(intrinsics, values, *biases)
        assert reported.shape == values.shape
        assert np.max(np.abs(correct_imu(intrinsics, reported, *biases) - values)) < 1e-13


def test_no_intrinsics_adds_biases_only() -> None:
    out = distort_imu(None, np.arange(6.0), [1, 2, 3], [10, 20, 30])
    assert out.tolist() == [1, 3, 5, 13, 24, 35]
