"""Rotations and poses as casadi expressions, with perturbations as everywhere in the project."""

from typing import Any

import casadi

ca: Any = casadi  # its stubs do not know mixed arguments
SX = Any

_EPSILON = 1e-14
"""Added to squared norms under a root: keeps derivatives finite and exact to rounding at zero."""


def skew(v: SX) -> SX:
    """Return the matrix with skew(v) u = v x u."""
    return ca.vertcat(
        ca.horzcat(0, -v[2], v[1]), ca.horzcat(v[2], 0, -v[0]), ca.horzcat(-v[1], v[0], 0)
    )


def rotation_matrix(q: SX) -> SX:
    """Return the matrix of a unit quaternion [x y z w]."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        ca.horzcat(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        ca.horzcat(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def multiply(a: SX, b: SX) -> SX:
    """Return the product of two quaternions [x y z w]."""
    vector = a[3] * b[:3] + b[3] * a[:3] + ca.cross(a[:3], b[:3])
    return ca.vertcat(vector, a[3] * b[3] - ca.dot(a[:3], b[:3]))


def conjugate(q: SX) -> SX:
    """Return the inverse of a unit quaternion."""
    return ca.vertcat(-q[:3], q[3])


def exp(phi: SX) -> SX:
    """Return the quaternion of a rotation vector."""
    angle = ca.sqrt(ca.dot(phi, phi) + _EPSILON)
    return ca.vertcat(ca.sin(0.5 * angle) / angle * phi, ca.cos(0.5 * angle))


def log(q: SX) -> SX:
    """Return the rotation vector (length <= pi) of a quaternion; q and -q give the same."""
    sine = ca.sqrt(ca.dot(q[:3], q[:3]) + _EPSILON)
    return 2 * ca.sign(q[3]) * ca.atan2(sine, ca.fabs(q[3])) / sine * q[:3]


class PerturbedPose:
    """A pose [q p] with its tangent [dp, dtheta]: p + dp, q exp(dtheta) to first order."""

    def __init__(self, name: str) -> None:
        """Make the symbols `name` (7) and `d_name` (6)."""
        self.values = ca.SX.sym(name, 7)
        self.tangent = ca.SX.sym("d_" + name, 6)
        self.q = multiply(self.values[:4], ca.vertcat(0.5 * self.tangent[3:], 1))
        # to first order the same as q, but linear, which keeps the expressions small
        self.R = rotation_matrix(self.values[:4]) @ (ca.SX.eye(3) + skew(self.tangent[3:]))
        self.p = self.values[4:] + self.tangent[:3]


class PerturbedVector:
    """A vector with an additive tangent of the same size."""

    def __init__(self, name: str, size: int) -> None:
        """Make the symbols `name` and `d_name`."""
        self.values = ca.SX.sym(name, size)
        self.tangent = ca.SX.sym("d_" + name, size)
        self.x = self.values + self.tangent


def with_jacobian(residual: SX, tangents: list[SX]) -> tuple[SX, SX]:
    """Return residual and its dense Jacobian by the tangents, both at tangent zero."""
    tangent = ca.vertcat(*tangents)
    jacobian = ca.densify(ca.jacobian(residual, tangent))
    zero = ca.SX.zeros(tangent.numel())
    value, slope = ca.substitute([residual, jacobian], [tangent], [zero])
    return ca.densify(value), ca.densify(slope)
