"""Prediction at samples against preintegration and against a body that falls."""

from __future__ import annotations

import numpy as np

from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.estimation.imu.propagation import propagate
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu
from tests.estimation.imu.motion import GRAVITY, one_edge, sampled


def test_last_state_is_what_the_preintegrated_edge_predicts():
    data = one_edge(*sampled(1.0, 200))
    b_g, b_a = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.05])
    T_A = se3.make(so3.exp([[0.1, -0.2, 0.7]]), [[1.0, 2.0, 3.0]])
    v_A = np.array([[0.5, -0.4, 0.3]])
    T, v = propagate(data, T_A, v_A, b_g, b_a, GRAVITY)
    edge = integrate(data, b_g, b_a)
    t = edge.duration_s[0]
    q = so3.multiply(T_A[0, :4], edge.q_A_B[0])
    p = T_A[0, 4:] + v_A[0] * t + GRAVITY * t**2 / 2 + so3.rotate(T_A[0, :4], edge.dp[0])
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(q), T[-1, :4])), 0, atol=1e-13)
    np.testing.assert_allclose(T[-1, 4:], p, atol=1e-11)
    expected_v = v_A[0] + GRAVITY * t + so3.rotate(T_A[0, :4], edge.dv[0])
    np.testing.assert_allclose(v[-1], expected_v, atol=1e-11)
    np.testing.assert_allclose(T[0], T_A[0], atol=1e-15)


def test_free_fall_of_several_edges_one_of_them_empty():
    stamps = np.concatenate([np.arange(11), np.arange(5)]) * 10_000_000
    data = InertialData(
        np.array([0, 11, 11, 16]), stamps, np.zeros((16, 6)), (Imu("0" * 32),), np.zeros(3, int)
    )
    v = np.array([[1.0, 0, 0], [9, 9, 9], [0, 2.0, 0]])
    T, velocity = propagate(data, se3.identity(3), v, np.zeros(3), np.zeros(3), GRAVITY)
    t = stamps * 1e-9
    start_v = np.repeat(v[[0, 2]], [11, 5], axis=0)
    np.testing.assert_allclose(
        T[:, 4:], start_v * t[:, None] + GRAVITY * t[:, None] ** 2 / 2, atol=1e-14
    )
    np.testing.assert_allclose(velocity, start_v + GRAVITY * t[:, None], atol=1e-14)
