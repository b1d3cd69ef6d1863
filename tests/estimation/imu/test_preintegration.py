"""Preintegration and propagation against closed forms and on recorded samples."""

import os
import subprocess
import sys

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate, propagate
from maplab_py.estimation.terms.inertial import SPEEDED_MPS, TURNED_RAD
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Imu, ImuIntrinsics
from tests.estimation.imu.motion import GRAVITY, one_edge, sampled, truth
from tests.support import imu_model
from tests.support.data import REPOSITORY

ZERO = np.zeros(3)
INTRINSICS = ImuIntrinsics(
    T_g=np.array([[1.02, 0.01, -0.02], [0, 0.97, 0.03], [0, 0, 1.01]]),
    T_a=np.array([[0.99, -0.02, 0.01], [0, 1.03, 0.02], [0, 0, 0.98]]),
    R_A_I=so3.to_matrix(so3.exp([0.02, -0.03, 0.01])),
)


def _as_vector(edges, reference):
    """Stack p, theta (right perturbation of a reference) and v of the first edge."""
    theta = so3.log(so3.multiply(so3.inverse(reference.q_A_B[0]), edges.q_A_B[0]))
    return np.concatenate([edges.dp[0], theta, edges.dv[0]])


def _errors(rate_hz):
    q, dv, dp = truth(2.0)
    edge = integrate(one_edge(*sampled(2.0, rate_hz)), ZERO, ZERO)
    theta = so3.log(so3.multiply(so3.inverse(q), edge.q_A_B[0]))
    return np.array(
        [np.linalg.norm(theta), np.linalg.norm(edge.dv[0] - dv), np.linalg.norm(edge.dp[0] - dp)]
    )


def test_error_falls_fourfold_when_the_rate_doubles():
    coarse, fine, finer = _errors(100), _errors(200), _errors(400)
    assert np.all(fine < 5e-4)
    assert np.all(coarse >= 3.9 * fine)
    assert np.all(fine >= 3.9 * finer)


def test_bias_jacobians_match_finite_differences():
    imu = Imu("0" * 32, intrinsics=INTRINSICS)
    data = one_edge(*sampled(0.5, 200), imu)
    b_g, b_a = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.05])
    center = integrate(data, b_g, b_a)
    step = 1e-6
    for axis in range(3):
        d = np.eye(3)[axis] * step
        forward, backward = integrate(data, b_g + d, b_a), integrate(data, b_g - d, b_a)
        numeric = (_as_vector(forward, center) - _as_vector(backward, center)) / (2 * step)
        np.testing.assert_allclose(center.jacobian_gyro_bias[0, :, axis], numeric, atol=2e-8)
        forward, backward = integrate(data, b_g, b_a + d), integrate(data, b_g, b_a - d)
        numeric = (_as_vector(forward, center) - _as_vector(backward, center)) / (2 * step)
        np.testing.assert_allclose(center.jacobian_accel_bias[0, :, axis], numeric, atol=2e-8)


def test_first_order_correction_suffices_where_edges_are_kept():
    data = one_edge(*sampled(0.2, 200))
    kept = integrate(data, ZERO, ZERO)
    for axis in range(6):
        change = np.eye(6)[axis] * (TURNED_RAD if axis < 3 else SPEEDED_MPS) / 0.2
        exact = integrate(data, change[:3], change[3:])
        jacobian = np.concatenate([kept.jacobian_gyro_bias, kept.jacobian_accel_bias], axis=2)[0]
        error = _as_vector(exact, kept) - _as_vector(kept, kept) - jacobian @ change
        assert np.all(np.abs(error[:6]) < 1e-9)  # metres and radians
        assert np.all(np.abs(error[6:]) < 2e-8)  # metres per second


def test_covariance_matches_monte_carlo():
    imu = Imu("0" * 32, gyro_noise_density=2e-3, acc_noise_density=3e-2, intrinsics=INTRINSICS)
    stamps, readings = sampled(1.0, 200)
    clean = integrate(one_edge(stamps, readings, imu), ZERO, ZERO)
    rng = np.random.default_rng(0)
    runs, dt = 20_000, 1.0 / 200
    sigma = np.repeat([imu.acc_noise_density, imu.gyro_noise_density], 3) / np.sqrt(dt)
    noisy = (readings + rng.normal(size=(runs, *readings.shape)) * sigma).reshape(-1, 6)
    start = np.arange(runs + 1) * len(stamps)
    many = InertialData(start, np.tile(stamps, runs), noisy, (imu,), np.zeros(runs, np.int64))
    edges = integrate(many, ZERO, ZERO)
    theta = so3.log(so3.multiply(so3.inverse(clean.q_A_B[0]), edges.q_A_B))
    error = np.concatenate([edges.dp - clean.dp, theta, edges.dv - clean.dv], axis=1)
    # whitened, the errors have unit covariance: sampling error is sqrt(2 / runs) = 1 %, the first
    # and last sample count half (one in 200 intervals)
    whitened = np.linalg.solve(np.linalg.cholesky(clean.covariance[0]), error.T)
    np.testing.assert_allclose(whitened @ whitened.T / runs, np.eye(9), atol=0.06)


def test_covariance_of_pure_white_noise_is_the_textbook_one():
    imu = Imu("0" * 32, gyro_noise_density=1e-3, acc_noise_density=2e-2)
    stamps = np.arange(2001) * 1_000_000
    edge = integrate(one_edge(stamps, np.zeros((2001, 6)), imu), ZERO, ZERO)
    T, sa2, sg2 = 2.0, 2e-2**2, 1e-3**2
    P = edge.covariance[0]
    assert P[6, 6] == pytest.approx(sa2 * T, rel=1e-9)
    assert P[0, 6] == pytest.approx(sa2 * T**2 / 2, rel=1e-6)
    assert P[0, 0] == pytest.approx(sa2 * T**3 / 3, rel=1e-3)
    assert P[3, 3] == pytest.approx(sg2 * T, rel=1e-9)
    assert edge.gyro_walk_variance[0] == pytest.approx(
        2 * imu.gyro_bias_random_walk_noise_density**2
    )
    assert edge.accel_walk_variance[0] == pytest.approx(
        2 * imu.acc_bias_random_walk_noise_density**2
    )


def test_two_edges_compose_to_the_long_one():
    stamps, readings = sampled(1.0, 200)
    b_g, b_a = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.05])
    whole = integrate(one_edge(stamps, readings), b_g, b_a)
    cut = 77
    halves = InertialData(
        np.array([0, cut + 1, len(stamps) + 1]),
        np.concatenate([stamps[: cut + 1], stamps[cut:]]),
        np.concatenate([readings[: cut + 1], readings[cut:]]),
        (Imu("0" * 32),),
        np.zeros(2, np.int64),
    )
    parts = integrate(halves, b_g, b_a)
    q = so3.multiply(parts.q_A_B[0], parts.q_A_B[1])
    dv = parts.dv[0] + so3.rotate(parts.q_A_B[0], parts.dv[1])
    t = parts.duration_s[1]
    dp = parts.dp[0] + parts.dv[0] * t + so3.rotate(parts.q_A_B[0], parts.dp[1])
    np.testing.assert_allclose(so3.log(so3.multiply(so3.inverse(q), whole.q_A_B[0])), 0, atol=1e-13)
    np.testing.assert_allclose(dv, whole.dv[0], atol=1e-12)
    np.testing.assert_allclose(dp, whole.dp[0], atol=1e-12)
    # covariance: the first edge's error is carried through the second one's motion
    R, R2 = so3.to_matrix(parts.q_A_B[0]), so3.to_matrix(parts.q_A_B[1])
    F, G = np.eye(9), np.zeros((9, 9))
    F[:3, 6:], F[3:6, 3:6] = np.eye(3) * t, R2.T
    F[:3, 3:6] = -R @ so3.skew(parts.dp[1])
    F[6:, 3:6] = -R @ so3.skew(parts.dv[1])
    G[:3, :3], G[3:6, 3:6], G[6:, 6:] = R, np.eye(3), R
    composed = F @ parts.covariance[0] @ F.T + G @ parts.covariance[1] @ G.T
    np.testing.assert_allclose(composed, whole.covariance[0], rtol=1e-8, atol=1e-16)


def test_intrinsics_and_biases_are_taken_off():
    stamps, readings = sampled(1.0, 200)
    b_g, b_a = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.05])
    measured = imu_model.distort_imu(INTRINSICS, readings, b_a, b_g)
    imu = Imu("0" * 32, intrinsics=INTRINSICS)
    ideal = integrate(one_edge(stamps, readings), ZERO, ZERO)
    edge = integrate(one_edge(stamps, measured, imu), b_g, b_a)
    np.testing.assert_allclose(edge.dp, ideal.dp, atol=1e-12)
    np.testing.assert_allclose(edge.dv, ideal.dv, atol=1e-12)
    np.testing.assert_allclose(edge.q_A_B, ideal.q_A_B, atol=1e-13)


def test_tiny_repeated_and_missing_intervals():
    stamps = np.array([0, 2_500, 2_500, 5_002_500, 7, 7, 9])
    readings = np.tile([0.1, 0.2, 9.8, 0.3, -0.2, 0.1], (7, 1))
    start = np.array([0, 4, 5, 5, 7])  # four samples; one; none; two
    data = InertialData(start, stamps, readings, (Imu("0" * 32),), np.zeros(4, np.int64))
    edges = integrate(data, ZERO, ZERO)
    np.testing.assert_allclose(edges.duration_s, [5.0025e-3, 0, 0, 2e-9])
    for name in ("dv", "dp", "q_A_B", "covariance", "jacobian_gyro_bias", "jacobian_accel_bias"):
        assert np.all(np.isfinite(getattr(edges, name)))
    np.testing.assert_array_equal(edges.dv[1:3], 0.0)
    np.testing.assert_array_equal(edges.covariance[1:3], 0.0)
    assert np.all(np.linalg.eigvalsh(edges.covariance[0]) > 0)


def test_bad_samples_are_refused_by_name():
    readings = np.zeros((5, 6))
    start, imus, of_edge = np.array([0, 2, 5]), (Imu("0" * 32),), np.zeros(2, np.int64)
    stamps = np.array([100, 200, 50, 70, 60])  # backwards between edges is fine, within is not
    with pytest.raises(MapError, match="IMU edge 1: the time of sample 2 is 10 ns before"):
        InertialData(start, stamps, readings, imus, of_edge)
    readings[3, 2] = np.nan
    names = np.array([[1, 2], [3, 4]], dtype=np.uint64)
    with pytest.raises(
        MapError, match="IMU edge 00000000000000030000000000000004: sample 1 is not"
    ):
        InertialData(start, np.sort(stamps), readings, imus, of_edge, names)


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


_COVARIANCE = (
    "import sys\nsys.path.append(sys.argv[1])\n"
    "from tests.estimation.imu.motion import one_edge, sampled\n"
    "from maplab_py.estimation.imu.preintegration import integrate\n"
    "edge = integrate(one_edge(*sampled(0.2, 200)), [0.01] * 3, [0.1] * 3)\n"
    "print(*edge.covariance.ravel().tolist())"
)


def test_it_is_the_same_without_compilation():
    """Rows that have names are views in Python, and values where they are lowered."""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    child = [sys.executable, "-c", _COVARIANCE, str(REPOSITORY)]
    plain = subprocess.run(child, env=environment, capture_output=True, text=True, check=True)
    compiled = integrate(one_edge(*sampled(0.2, 200)), [0.01] * 3, [0.1] * 3)
    found = np.array([float(word) for word in plain.stdout.split()])
    np.testing.assert_allclose(compiled.covariance.ravel(), found, rtol=1e-12)
