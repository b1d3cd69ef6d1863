"""Every residual's Jacobian against central differences, and the lowered code against casadi."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.kernels.visual_arguments import VisualData, VisualStates
from maplab_py.estimation.symbolic.sources import absolute_pose, inertial, relative_pose
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Distortion, Projection
from maplab_py.sensors.projection import project
from tests.support.kernels import TWO_MODELS
from tests.support.scene import EVERY_MODEL, make_camera


def assert_relative(jacobian: np.ndarray, wanted: np.ndarray) -> None:
    """Compare to 1e-6 of the largest entry of each row."""
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.all(np.abs(jacobian - wanted) <= 1e-6 * size)


@pytest.mark.parametrize(("projection", "distortion"), EVERY_MODEL)
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-6, 0.3, 1.2])
def test_reprojection_agrees_with_the_sensor_model_and_with_differences(
    projection: Projection, distortion: Distortion, offset: float
) -> None:
    from maplab_py.estimation.symbolic.residuals import reprojection

    model = make_camera(projection, distortion)
    T_G_I = se3.make(so3.exp([0.2, -0.4, 0.1]), [0.5, -0.2, 0.3])
    T_I_C = se3.make(so3.exp([-0.1, 0.3, 1.2]), [0.05, 0.02, -0.1])
    T_G_C = se3.compose(T_G_I, T_I_C)
    p_G = se3.transform(T_G_C, np.array([offset, -0.5 * offset, 2.0]))
    uv = np.array([300.0, 200.0])
    parameters = np.concatenate([model.intrinsics, model.distortion_parameters])
    function = reprojection(projection, distortion)

    def residual(delta: np.ndarray) -> np.ndarray:
        pose = se3.retract(T_G_I, delta[:6])
        p_C = se3.transform(se3.inverse(se3.compose(pose, T_I_C)), p_G + delta[6:])
        return np.asarray(project(model, p_C)[0]) - uv

    value, depth, jacobian = (
        np.asarray(part) for part in function(T_G_I, T_I_C, parameters, p_G, uv)[:3]
    )
    np.testing.assert_allclose(value[:, 0], residual(np.zeros(9)), atol=1e-9)
    assert depth[0, 0] == pytest.approx(2.0)
    assert_relative(jacobian, differences(residual, 9))


@pytest.mark.parametrize(("projection", "distortion"), EVERY_MODEL)
@pytest.mark.parametrize("inverse_depth", [1e-6, 0.1, 2.0])
def test_anchored_reprojection_agrees_with_the_sensor_model_and_with_differences(
    projection: Projection, distortion: Distortion, inverse_depth: float
) -> None:
    from maplab_py.estimation.symbolic.residuals import anchored_reprojection

    model = make_camera(projection, distortion)
    T_M_A = se3.make(so3.exp([0.2, -0.4, 0.1]), [0.5, -0.2, 0.3])
    T_M_I = se3.retract(T_M_A, [0.05, -0.1, 0.08, 0.1, -0.05, 0.15])
    T_I_CA = se3.make(so3.exp([-0.1, 0.3, 1.2]), [0.05, 0.02, -0.1])
    T_I_C = se3.retract(T_I_CA, [0.1, 0.0, 0.02, 0.02, -0.01, 0.03])
    h, uv = np.array([0.2, -0.1, inverse_depth]), np.array([300.0, 200.0])
    parameters = np.concatenate([model.intrinsics, model.distortion_parameters])
    function = anchored_reprojection(projection, distortion)

    def ray_C(delta: np.ndarray) -> np.ndarray:
        """Return the landmark in C times its inverse depth, by homogeneous coordinates."""
        x, y, w = h + delta[12:]
        T_M_C = se3.compose(se3.retract(T_M_I, delta[6:12]), T_I_C)
        T_M_CA = se3.compose(se3.retract(T_M_A, delta[:6]), T_I_CA)
        matrix = se3.to_matrix(se3.relative(T_M_C, T_M_CA))
        return np.asarray(matrix @ [x, y, 1.0, w])[:3]

    def residual(delta: np.ndarray) -> np.ndarray:
        return np.asarray(project(model, ray_C(delta))[0]) - uv

    value, depth, by_anchor, by_frame, by_landmark = (
        np.asarray(part) for part in function(T_M_A, T_I_CA, T_M_I, T_I_C, parameters, h, uv)
    )
    np.testing.assert_allclose(value[:, 0], residual(np.zeros(15)), atol=1e-9)
    assert depth[0, 0] == pytest.approx(ray_C(np.zeros(15))[2])
    np.testing.assert_allclose(by_anchor[:, :3], -by_frame[:, :3], atol=1e-9)
    jacobian = np.concatenate([by_anchor, by_frame, by_landmark], axis=1)
    assert_relative(jacobian, differences(residual, 15))


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.5, 2.0])
def test_inertial_jacobian(scale: float) -> None:
    rng = np.random.default_rng(3)
    kernel = residual_kernel("inertial", inertial)
    T_A = se3.make(so3.exp([0.3, -0.2, 0.8]), [1.0, 2.0, 3.0])
    T_B = se3.make(so3.multiply(T_A[:4], so3.exp(scale * np.array([1.0, -0.5, 0.2]))), [1.1, 2, 3])
    v_A, v_B = np.array([1.0, 0.1, 0.0]), np.array([1.1, 0.0, 0.1])
    fixed = np.concatenate(
        [
            so3.exp(0.9 * scale * np.array([1.0, -0.4, 0.3])),
            rng.normal(size=6) * 0.1,
            rng.normal(size=54) * 0.1,
            rng.normal(size=6) * 0.01,
            [0.1, 0.0, 0.0, -9.81],
        ]
    )

    def residual(delta: np.ndarray) -> np.ndarray:
        a, b = se3.retract(T_A, delta[:6]), se3.retract(T_B, delta[15:21])
        moving = [a, v_A + delta[6:9], 0.01 + delta[9:12], 0.02 + delta[12:15], b, v_B + delta[21:]]
        return evaluate(kernel, np.concatenate([*moving, fixed]), 9, 24)[0]

    zero = np.concatenate([T_A, v_A, np.full(3, 0.01), np.full(3, 0.02), T_B, v_B, fixed])
    jacobian = evaluate(kernel, zero, 9, 24)[1]
    assert_relative(jacobian, differences(residual, 24))


@pytest.mark.parametrize("with_mounting", [False, True])
@pytest.mark.parametrize("scale", [0.9, 1.0, 1.02])
def test_scaled_relative_pose_jacobian(scale: float, with_mounting: bool) -> None:
    from maplab_py.estimation.symbolic.residuals import relative_pose as unscaled
    from maplab_py.estimation.symbolic.residuals import scaled_relative_pose

    T_A = se3.make(so3.exp([0.3, -0.2, 0.8]), [1.0, 2.0, 3.0])
    T_B = se3.make(so3.exp([0.1, 0.5, 0.7]), [1.5, 2.2, 2.9])
    T_I_S = se3.make(so3.exp([0.2, 0.1, -0.4]), [0.1, 0.2, -0.1])
    measured = se3.make(so3.exp([0.02, -0.1, 0.3]), [0.5, 0.1, -0.05])
    function = scaled_relative_pose(with_mounting=with_mounting)

    def residual(delta: np.ndarray) -> np.ndarray:
        A, B = se3.retract(T_A, delta[:6]), se3.retract(T_B, delta[6:12])
        S = se3.retract(T_I_S, delta[12:18]) if with_mounting else T_I_S
        T = se3.relative(se3.compose(A, S), se3.compose(B, S))
        turn = so3.log(so3.multiply(so3.inverse(measured[:4]), T[:4]))
        return np.concatenate([(scale + delta[-3]) * T[4:] - measured[4:], turn])

    size = 21 if with_mounting else 15
    value, jacobian = (
        np.asarray(part)
        for part in function(T_A, T_B, T_I_S, measured, np.array([scale, 0.0, 0.0]))
    )
    assert jacobian.shape == (6, size)
    np.testing.assert_allclose(value[:, 0], residual(np.zeros(size)), atol=1e-12)
    assert_relative(jacobian, differences(residual, size))
    if scale == 1.0:
        same = np.asarray(unscaled()(T_A, T_B, T_I_S, measured)[0])
        np.testing.assert_allclose(value, same, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.4, 3.0])
def test_pose_jacobians(angle: float) -> None:
    T_A = se3.make(so3.exp([0.3, -0.2, 0.8]), [1.0, 2.0, 3.0])
    T_B = se3.make(so3.exp([0.1, 0.5, 0.7]), [1.5, 2.2, 2.9])
    T_I_S = se3.make(so3.exp([0.2, 0.1, -0.4]), [0.1, 0.2, -0.1])
    off = se3.make(so3.exp(angle * np.array([0.6, -0.8, 0.0])), [0.02, 0.0, -0.01])
    S_A, S_B = se3.compose(T_A, T_I_S), se3.compose(T_B, T_I_S)
    relative = residual_kernel("relative_pose", relative_pose)
    absolute = residual_kernel("absolute_pose", absolute_pose)
    measured = se3.compose(se3.relative(S_A, S_B), off)
    measured_G = se3.compose(S_A, off)

    def of_relative(delta: np.ndarray) -> np.ndarray:
        poses = [se3.retract(T_A, delta[:6]), se3.retract(T_B, delta[6:])]
        return evaluate(relative, np.concatenate([*poses, T_I_S, measured]), 6, 12)[0]

    def of_absolute(delta: np.ndarray) -> np.ndarray:
        pose = se3.retract(T_A, delta)
        return evaluate(absolute, np.concatenate([pose, T_I_S, measured_G]), 6, 6)[0]

    jacobian = evaluate(relative, np.concatenate([T_A, T_B, T_I_S, measured]), 6, 12)[1]
    assert_relative(jacobian, differences(of_relative, 12))
    jacobian = evaluate(absolute, np.concatenate([T_A, T_I_S, measured_G]), 6, 6)[1]
    assert_relative(jacobian, differences(of_absolute, 6))
    expected = angle * np.array([-0.6, 0.8, 0.0])
    np.testing.assert_allclose(of_absolute(np.zeros(6))[3:], expected, atol=1e-12)


def test_kernels_of_several_models_choose_by_camera() -> None:
    kernels = visual_kernels(TWO_MODELS)
    parameters = np.array([[1, 100, 100, 50, 50, 0.0], [0, 100, 100, 50, 50, 0.9]])
    result = np.empty((2, 2))
    start = np.array([0, 2], dtype=np.int64)
    rows = np.zeros(2, dtype=np.int32), np.array([0, 1], dtype=np.int32)
    uv, p_G, one = np.full((2, 2), 50.0), np.array([[1.0, 0.0, 1.0]]), np.ones(2)
    data = VisualData(start, *rows, uv, one, one, np.zeros((0, 2)))
    at = VisualStates(se3.identity(1), se3.identity(2), parameters, p_G, np.zeros((2, 1)))
    kernels.evaluate(data, at, result)
    fov = 100.0 * np.arctan(2.0 * np.tan(0.45)) / 0.9
    np.testing.assert_allclose(result, [[100.0, 1.0], [fov, 1.0]], rtol=1e-12)


def evaluate(kernel: object, x: np.ndarray, size: int, columns: int) -> tuple[np.ndarray, ...]:
    residual, jacobian = np.empty((1, size)), np.empty((1, size, columns))
    kernel.evaluate(x[None], np.eye(size)[None], residual, jacobian)  # type: ignore[attr-defined]
    return residual[0], jacobian[0]


def differences(function: object, count: int) -> np.ndarray:
    """Return the Jacobian by central differences of fourth order."""
    columns = []
    for k in range(count):
        d = np.zeros(count)
        d[k] = 1e-3
        columns.append(
            (8 * (function(d) - function(-d)) - function(2 * d) + function(-2 * d)) / 0.012
        )  # type: ignore[operator]
    return np.stack(columns, axis=1)
