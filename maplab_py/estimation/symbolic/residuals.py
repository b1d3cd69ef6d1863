"""Every residual of the visual-inertial least squares, once.

A residual function takes values (poses [q p], vectors, data) and returns the residual and its
Jacobian by the tangents of its variables, in the order given. Poses are T_G_I; nothing here is
whitened: weights belong to the term that uses the residual.
"""

from typing import Any

import casadi

from maplab_py.estimation.symbolic.manifold import (
    PerturbedPose,
    PerturbedVector,
    conjugate,
    exp,
    log,
    multiply,
    with_jacobian,
)

ca: Any = casadi  # its stubs do not know mixed arguments


def inertial(*, with_intrinsics: bool = False) -> Any:
    """Return the residual (9: position, orientation, velocity) of a preintegrated edge A -> B.

    f(T_A, v_A, b_g, b_a, T_B, v_B, q_A_B, dp, dv, J_g, J_a, b_g0, b_a0, dt, g) with J_g, J_a (9 x 3,
    rows p, theta, v) and biases' linearisation point b_g0, b_a0; tangents [T_A 6, v_A 3, b_g 3,
    b_a 3, T_B 6, v_B 3]. Source: Forster et al., TRO 2017, eq. (44)-(45).

    With intrinsics one more input J_i (9 x 15) and as many more tangents follow; the measurement
    has to be integrated at their present values.
    """
    T_A, T_B = PerturbedPose("T_A"), PerturbedPose("T_B")
    v_A, v_B = PerturbedVector("v_A", 3), PerturbedVector("v_B", 3)
    b_g, b_a = PerturbedVector("b_g", 3), PerturbedVector("b_a", 3)
    q_A_B, dp, dv = ca.SX.sym("q_A_B", 4), ca.SX.sym("dp", 3), ca.SX.sym("dv", 3)
    J_g, J_a = ca.SX.sym("J_g", 9, 3), ca.SX.sym("J_a", 9, 3)
    b_g0, b_a0 = ca.SX.sym("b_g0", 3), ca.SX.sym("b_a0", 3)
    dt, g = ca.SX.sym("dt"), ca.SX.sym("g", 3)
    J_i, d_intrinsics = ca.SX.sym("J_i", 9, 15), ca.SX.sym("d_intrinsics", 15)
    change = J_g @ (b_g.x - b_g0) + J_a @ (b_a.x - b_a0)
    if with_intrinsics:
        change = change + J_i @ d_intrinsics
    predicted = multiply(q_A_B, exp(change[3:6]))
    r_p = T_A.R.T @ (T_B.p - T_A.p - v_A.x * dt - 0.5 * g * dt * dt) - (dp + change[0:3])
    r_theta = log(multiply(conjugate(predicted), multiply(conjugate(T_A.q), T_B.q)))
    r_v = T_A.R.T @ (v_B.x - v_A.x - g * dt) - (dv + change[6:9])
    variables: list[Any] = [T_A, v_A, b_g, b_a, T_B, v_B]
    data = [q_A_B, dp, dv, J_g, J_a, b_g0, b_a0, dt, g]
    tangents = [variable.tangent for variable in variables]
    if with_intrinsics:
        data.append(J_i)
        tangents.append(d_intrinsics)
    value, jacobian = with_jacobian(ca.vertcat(r_p, r_theta, r_v), tangents)
    arguments = [variable.values for variable in variables] + data
    return ca.Function("inertial", arguments, ca.cse([value, jacobian]))


def relative_pose(*, with_mounting: bool = False) -> Any:
    """Return the residual (6: position, orientation) of a measured T_SA_SB of a sensor S.

    f(T_A, T_B, T_I_S, T_SA_SB): e = [p - p_measured, Log(R_measured^T R)] of
    (T_A T_I_S)^-1 (T_B T_I_S); tangents [T_A 6, T_B 6] and, with the mounting, [T_I_S 6].
    """
    T_A, T_B, T_I_S = PerturbedPose("T_A"), PerturbedPose("T_B"), PerturbedPose("T_I_S")
    measured = ca.SX.sym("T_SA_SB", 7)
    p_A_SB = T_A.R.T @ (T_B.R @ T_I_S.p + T_B.p - T_A.p)
    position = T_I_S.R.T @ (p_A_SB - T_I_S.p) - measured[4:]
    q_A_B = multiply(conjugate(T_A.q), T_B.q)
    q = multiply(conjugate(T_I_S.q), multiply(q_A_B, T_I_S.q))
    orientation = log(multiply(conjugate(measured[:4]), q))
    tangents = [T_A.tangent, T_B.tangent, T_I_S.tangent]
    value, jacobian = with_jacobian(ca.vertcat(position, orientation), tangents)
    arguments = [T_A.values, T_B.values, T_I_S.values, measured]
    jacobian = jacobian if with_mounting else jacobian[:, :12]
    return ca.Function("relative_pose", arguments, ca.cse([value, jacobian]))


def scaled_relative_pose(*, with_mounting: bool = False) -> Any:
    """Return `relative_pose` of a sensor whose reported positions are s times the true ones.

    f(T_A, T_B, T_I_S, T_SA_SB, s): e = [s p - p_measured, Log(R_measured^T R)]; tangents [T_A 6, T_B 6],
    with the mounting [T_I_S 6], and [s 3], of which only the first means anything. The measured position
    is not divided by s, so that its covariance does not depend on s.
    """
    T_A, T_B, T_I_S = PerturbedPose("T_A"), PerturbedPose("T_B"), PerturbedPose("T_I_S")
    measured, s = ca.SX.sym("T_SA_SB", 7), PerturbedVector("s", 3)
    p_A_SB = T_A.R.T @ (T_B.R @ T_I_S.p + T_B.p - T_A.p)
    position = s.x[0] * (T_I_S.R.T @ (p_A_SB - T_I_S.p)) - measured[4:]
    q_A_B = multiply(conjugate(T_A.q), T_B.q)
    q = multiply(conjugate(T_I_S.q), multiply(q_A_B, T_I_S.q))
    orientation = log(multiply(conjugate(measured[:4]), q))
    tangents = [T_A.tangent, T_B.tangent, T_I_S.tangent, s.tangent]
    value, jacobian = with_jacobian(ca.vertcat(position, orientation), tangents)
    if not with_mounting:
        jacobian = ca.horzcat(jacobian[:, :12], jacobian[:, 18:])
    arguments = [T_A.values, T_B.values, T_I_S.values, measured, s.values]
    return ca.Function("scaled_relative_pose", arguments, ca.cse([value, jacobian]))


def absolute_pose(*, with_mounting: bool = False) -> Any:
    """Return the residual (6: position, orientation) of a measured T_G_S.

    f(T_G_I, T_I_S, T_G_S): e = [p - p_measured, Log(R_measured^T R)] of T_G_I T_I_S; tangents
    [T_G_I 6] and, with the mounting, [T_I_S 6].
    """
    T_G_I, T_I_S = PerturbedPose("T_G_I"), PerturbedPose("T_I_S")
    measured = ca.SX.sym("T_G_S", 7)
    position = T_G_I.R @ T_I_S.p + T_G_I.p - measured[4:]
    orientation = log(multiply(conjugate(measured[:4]), multiply(T_G_I.q, T_I_S.q)))
    tangents = [T_G_I.tangent, T_I_S.tangent]
    value, jacobian = with_jacobian(ca.vertcat(position, orientation), tangents)
    jacobian = jacobian if with_mounting else jacobian[:, :6]
    arguments = [T_G_I.values, T_I_S.values, measured]
    return ca.Function("absolute_pose", arguments, ca.cse([value, jacobian]))


def switched_relative_pose() -> Any:
    """Return `relative_pose` without mounting, multiplied by a switch s: f(T_A, T_B, s, T_A_B).

    Tangents [T_A 6, T_B 6, s 3], of which only the first of s means anything. Source: Sunderhauf
    and Protzel, Switchable Constraints for Robust Pose Graph SLAM, IROS 2012, eq. (6).
    """
    T_A, T_B, s = PerturbedPose("T_A"), PerturbedPose("T_B"), PerturbedVector("s", 3)
    measured = ca.SX.sym("T_A_B", 7)
    position = T_A.R.T @ (T_B.p - T_A.p) - measured[4:]
    q = multiply(conjugate(measured[:4]), multiply(conjugate(T_A.q), T_B.q))
    residual = s.x[0] * ca.vertcat(position, log(q))
    value, jacobian = with_jacobian(residual, [T_A.tangent, T_B.tangent, s.tangent])
    arguments = [T_A.values, T_B.values, s.values, measured]
    return ca.Function("switched_relative_pose", arguments, ca.cse([value, jacobian]))
