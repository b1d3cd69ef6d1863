"""Every residual of the visual-inertial least squares, once.

A residual function takes values (poses [q p], vectors, data) and returns the residual and its
Jacobian by the tangents of its variables, in the order given. Poses are T_G_I; nothing here is
whitened: weights belong to the term that uses the residual.
"""

from __future__ import annotations

from typing import Any

import casadi

from maplab_py.estimation.symbolic.cameras import project
from maplab_py.estimation.symbolic.manifold import (
    PerturbedPose,
    PerturbedVector,
    conjugate,
    exp,
    log,
    multiply,
    rotation_matrix,
    with_jacobian,
)
from maplab_py.sensors.camera import DISTORTION_SIZE, INTRINSICS_SIZE, Distortion, Projection

ca: Any = casadi  # its stubs do not know mixed arguments


def reprojection(projection: Projection, distortion: Distortion) -> Any:
    """Return f(T_G_I, T_I_C, parameters, p_G, uv) -> r (2), depth (1), J (2 x 9: pose, landmark).

    r = projection of the landmark - measured pixel; depth is the camera-frame z coordinate.
    """
    T_G_I, p_G = PerturbedPose("T_G_I"), PerturbedVector("p_G", 3)
    T_I_C = ca.SX.sym("T_I_C", 7)
    parameters = ca.SX.sym("parameters", INTRINSICS_SIZE[projection] + DISTORTION_SIZE[distortion])
    uv = ca.SX.sym("uv", 2)
    p_I = T_G_I.R.T @ (p_G.x - T_G_I.p)
    p_C = rotation_matrix(T_I_C[:4]).T @ (p_I - T_I_C[4:])
    residual = project(projection, distortion, p_C, parameters) - uv
    value, jacobian = with_jacobian(residual, [T_G_I.tangent, p_G.tangent])
    tangent = ca.vertcat(T_G_I.tangent, p_G.tangent)
    depth = ca.substitute(p_C[2], tangent, ca.SX.zeros(9))
    arguments = [T_G_I.values, T_I_C, parameters, p_G.values, uv]
    return ca.Function("reprojection", arguments, ca.cse([value, depth, jacobian]))


def inertial() -> Any:
    """Return the residual (9: position, orientation, velocity) of a preintegrated edge A -> B.

    f(T_A, v_A, b_g, b_a, T_B, v_B, q_A_B, dp, dv, J_g, J_a, b_g0, b_a0, dt, g) with J_g, J_a (9 x 3,
    rows p, theta, v) and biases' linearisation point b_g0, b_a0; tangents [T_A 6, v_A 3, b_g 3,
    b_a 3, T_B 6, v_B 3]. Source: Forster et al., TRO 2017, eq. (44)-(45).
    """
    T_A, T_B = PerturbedPose("T_A"), PerturbedPose("T_B")
    v_A, v_B = PerturbedVector("v_A", 3), PerturbedVector("v_B", 3)
    b_g, b_a = PerturbedVector("b_g", 3), PerturbedVector("b_a", 3)
    q_A_B, dp, dv = ca.SX.sym("q_A_B", 4), ca.SX.sym("dp", 3), ca.SX.sym("dv", 3)
    J_g, J_a = ca.SX.sym("J_g", 9, 3), ca.SX.sym("J_a", 9, 3)
    b_g0, b_a0 = ca.SX.sym("b_g0", 3), ca.SX.sym("b_a0", 3)
    dt, g = ca.SX.sym("dt"), ca.SX.sym("g", 3)
    change = J_g @ (b_g.x - b_g0) + J_a @ (b_a.x - b_a0)
    predicted = multiply(q_A_B, exp(change[3:6]))
    r_p = T_A.R.T @ (T_B.p - T_A.p - v_A.x * dt - 0.5 * g * dt * dt) - (dp + change[0:3])
    r_theta = log(multiply(conjugate(predicted), multiply(conjugate(T_A.q), T_B.q)))
    r_v = T_A.R.T @ (v_B.x - v_A.x - g * dt) - (dv + change[6:9])
    variables: list[Any] = [T_A, v_A, b_g, b_a, T_B, v_B]
    value, jacobian = with_jacobian(
        ca.vertcat(r_p, r_theta, r_v), [variable.tangent for variable in variables]
    )
    data = [q_A_B, dp, dv, J_g, J_a, b_g0, b_a0, dt, g]
    arguments = [variable.values for variable in variables] + data
    return ca.Function("inertial", arguments, ca.cse([value, jacobian]))


def relative_pose() -> Any:
    """Return the residual (6: position, orientation) of a measured T_SA_SB of a sensor S.

    f(T_A, T_B, T_I_S, T_SA_SB): e = [p - p_measured, Log(R_measured^T R)] of
    (T_A T_I_S)^-1 (T_B T_I_S); tangents [T_A 6, T_B 6].
    """
    T_A, T_B = PerturbedPose("T_A"), PerturbedPose("T_B")
    T_I_S, measured = ca.SX.sym("T_I_S", 7), ca.SX.sym("T_SA_SB", 7)
    R_I_S = rotation_matrix(T_I_S[:4])
    p_A_SB = T_A.R.T @ (T_B.R @ T_I_S[4:] + T_B.p - T_A.p)
    position = R_I_S.T @ (p_A_SB - T_I_S[4:]) - measured[4:]
    q_A_B = multiply(conjugate(T_A.q), T_B.q)
    q = multiply(conjugate(T_I_S[:4]), multiply(q_A_B, T_I_S[:4]))
    orientation = log(multiply(conjugate(measured[:4]), q))
    value, jacobian = with_jacobian(ca.vertcat(position, orientation), [T_A.tangent, T_B.tangent])
    arguments = [T_A.values, T_B.values, T_I_S, measured]
    return ca.Function("relative_pose", arguments, ca.cse([value, jacobian]))


def absolute_pose() -> Any:
    """Return the residual (6: position, orientation) of a measured T_G_S.

    f(T_G_I, T_I_S, T_G_S): e = [p - p_measured, Log(R_measured^T R)] of T_G_I T_I_S.
    """
    T_G_I = PerturbedPose("T_G_I")
    T_I_S, measured = ca.SX.sym("T_I_S", 7), ca.SX.sym("T_G_S", 7)
    position = T_G_I.R @ T_I_S[4:] + T_G_I.p - measured[4:]
    orientation = log(multiply(conjugate(measured[:4]), multiply(T_G_I.q, T_I_S[:4])))
    value, jacobian = with_jacobian(ca.vertcat(position, orientation), [T_G_I.tangent])
    return ca.Function("absolute_pose", [T_G_I.values, T_I_S, measured], ca.cse([value, jacobian]))
