"""Every residual's Jacobian against central differences, and the lowered code against casadi."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.symbolic.sources import absolute_pose, inertial, relative_pose
from maplab_py.geometry import se3, so3
from tests.estimation.dense import assert_relative, differences


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


def evaluate(kernel: object, x: np.ndarray, size: int, columns: int) -> tuple[np.ndarray, ...]:
    residual, jacobian = np.empty((1, size)), np.empty((1, size, columns))
    kernel.evaluate(x[None], np.eye(size)[None], residual, jacobian)  # type: ignore[attr-defined]
    return residual[0], jacobian[0]
