"""Residuals of pose graphs, with derivatives by twists: a pose moves to T exp(x), x = [v, w].

Where half a trajectory turns about a far corner, twists keep its shape and sums of positions stretch
it: Gauss-Newton needs half of the iterations.
"""

from collections.abc import Callable
from typing import Any

import casadi

from maplab_py.estimation.symbolic import manifold

ca: Any = casadi  # its stubs do not know mixed arguments
SX = Any

Error = Callable[[SX, SX, SX], SX]
"""Residual (6: position, angle) of a relative pose: f(q_A_B, p_A_B, measured T_A_B)."""

_SMALL_SQUARED_ANGLE = 1e-4


def split_error(q_A_B: SX, p_A_B: SX, measured: SX) -> SX:
    """Return [p_A_B - p_measured, Log(R_measured^T R_A_B)], the position part in A."""
    angle = manifold.log(manifold.multiply(manifold.conjugate(measured[:4]), q_A_B))
    return ca.vertcat(p_A_B - measured[4:], angle)


def logarithmic_error(q_A_B: SX, p_A_B: SX, measured: SX) -> SX:
    """Return Log(T_measured^-1 T_A_B) in SE(3).

    Source: Barfoot, State Estimation for Robotics, 2017, eq. (7.37) and (7.86b).
    """
    angle = manifold.log(manifold.multiply(manifold.conjugate(measured[:4]), q_A_B))
    p = manifold.rotation_matrix(measured[:4]).T @ (p_A_B - measured[4:])
    once = ca.cross(angle, p)
    twice = ca.cross(angle, once)
    return ca.vertcat(p - 0.5 * once + _second_coefficient(angle) * twice, angle)


def _second_coefficient(angle: SX) -> SX:
    """Return b of Jl^-1 = I - K / 2 + b K^2, K = skew(angle)."""
    square = ca.dot(angle, angle)
    is_small = square < _SMALL_SQUARED_ANGLE
    series = 1 / 12 + square / 720 + square * square / 30240
    safe = ca.if_else(is_small, 1.0, square)
    half = 0.5 * ca.sqrt(safe)
    return ca.if_else(is_small, series, (1 - half * ca.cos(half) / ca.sin(half)) / safe)


def linearised(error: Error) -> Any:
    """Return f(T_A, T_B, T_measured) -> e (6), and transposed J_B and C (6 x 6) of its derivatives.

    Those by twists of B are J_B, those by twists of A are J_B C.
    """
    T_A, T_B, measured, q, p, x = _symbols()
    at_twist = error(*_moved(q, p, x), measured)
    J_B, value = (_at_zero(result, x) for result in (ca.jacobian(at_twist, x), at_twist))
    results = [value, J_B.T, -_adjoint_of_inverse(q, p).T]
    arguments = [T_A, T_B, measured]
    return ca.Function("linearised", arguments, ca.cse([ca.densify(result) for result in results]))


def second_derivatives(error: Error) -> Any:
    """Return f(T_A, T_B, T_measured, g) -> second derivatives (6 x 6) of g^T e: AA, BB and BA.

    Of AA and BB only the lower triangles are filled in.
    To second order exp(-x_A) T_A_B exp(x_B) = T_A_B exp(x_B - a - [a, x_B] / 2), where a is x_A as B
    sees it.
    """
    T_A, T_B, measured, q, p, x = _symbols()
    g, a, x_B = ca.SX.sym("g", 6), ca.SX.sym("a", 6), ca.SX.sym("x_B", 6)
    hessian, gradient = ca.hessian(ca.dot(g, error(*_moved(q, p, x), measured)), x)
    hessian, gradient = _at_zero(hessian, x), _at_zero(gradient, x)
    bracket = ca.vertcat(
        ca.cross(a[3:], x_B[:3]) + ca.cross(a[:3], x_B[3:]), ca.cross(a[3:], x_B[3:])
    )
    mixed = ca.jacobian(ca.jacobian(-0.5 * ca.dot(gradient, bracket), x_B).T, a)
    to_B = _adjoint_of_inverse(q, p)
    results = [ca.tril(to_B.T @ hessian @ to_B), ca.tril(hessian), (mixed - hessian) @ to_B]
    arguments = [T_A, T_B, measured, g]
    return ca.Function("second", arguments, ca.cse([ca.densify(result) for result in results]))


def tilt() -> Any:
    """Return f(T_G_I, q_G_I measured) -> (R_measured d)_xy, d = Log(R_measured^T R), and J (2 x 6).

    That is the part of the rotation away from the measured attitude that is about horizontal axes.
    """
    T_G_I, measured, x = ca.SX.sym("T_G_I", 7), ca.SX.sym("q_G_I", 4), ca.SX.sym("x", 6)
    q, _ = _moved(T_G_I[:4], T_G_I[4:], x)
    rotated = manifold.rotation_matrix(measured) @ manifold.log(
        manifold.multiply(manifold.conjugate(measured), q)
    )
    results = [_at_zero(result, x) for result in (rotated[:2], ca.jacobian(rotated[:2], x))]
    return ca.Function("tilt", [T_G_I, measured], ca.cse([ca.densify(r) for r in results]))


def retraction() -> Any:
    """Return f(T, x) -> T exp(x)."""
    T, x = ca.SX.sym("T", 7), ca.SX.sym("x", 6)
    v, w = x[:3], x[3:]
    angle = ca.sqrt(ca.dot(w, w) + 1e-14)
    half_sine = ca.sin(0.5 * angle) / angle
    p = (
        v
        + 2 * half_sine * half_sine * ca.cross(w, v)
        + (angle - ca.sin(angle)) / (angle * angle * angle) * ca.cross(w, ca.cross(w, v))
    )
    q = manifold.multiply(T[:4], manifold.exp(w))
    moved = ca.vertcat(q / ca.sqrt(ca.dot(q, q)), T[4:] + manifold.rotation_matrix(T[:4]) @ p)
    return ca.Function("retraction", [T, x], ca.cse([moved]))


def _symbols() -> tuple[SX, SX, SX, SX, SX, SX]:
    """Return T_A, T_B, T_measured, the relative pose q_A_B and p_A_B, and the twist x of B."""
    T_A, T_B, measured = (ca.SX.sym(name, 7) for name in ("T_A", "T_B", "T_measured"))
    q_A_B = manifold.multiply(manifold.conjugate(T_A[:4]), T_B[:4])
    p_A_B = manifold.rotation_matrix(T_A[:4]).T @ (T_B[4:] - T_A[4:])
    return T_A, T_B, measured, q_A_B, p_A_B, ca.SX.sym("x", 6)


def _moved(q: SX, p: SX, x: SX) -> tuple[SX, SX]:
    """Return q and p of T exp(x), exact to second order."""
    v, w = x[:3], x[3:]
    step = ca.vertcat(0.5 * w, 1 - ca.dot(w, w) / 8)
    return manifold.multiply(q, step), p + manifold.rotation_matrix(q) @ (v + 0.5 * ca.cross(w, v))


def _adjoint_of_inverse(q_A_B: SX, p_A_B: SX) -> SX:
    """Return the matrix (6 x 6) that takes twists of A to those of B with the same effect."""
    R_B_A = manifold.rotation_matrix(q_A_B).T
    top, bottom = ca.horzcat(R_B_A, -R_B_A @ manifold.skew(p_A_B)), ca.horzcat(ca.SX(3, 3), R_B_A)
    return ca.vertcat(top, bottom)


def _at_zero(expression: SX, x: SX) -> SX:
    return ca.substitute(expression, x, ca.SX.zeros(x.numel()))
