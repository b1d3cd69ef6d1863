"""Preconditioned conjugate gradients with early termination (truncated Newton steps).

Hestenes and Stiefel, Methods of Conjugate Gradients for Solving Linear Systems, 1952; the residual is
measured in the norm of the preconditioner, r' M^-1 r, which weighs metres, radians and biases alike
(Dembo, Eisenstat and Steihaug, Inexact Newton Methods, 1982, for the forcing term).

The test of Nash and Sofer (the gain of an iteration against the gain so far) is not used: on chains
of poses progress comes in plateaus, where that test stops too early.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.linear.protocol import NotPositiveDefinite

Operator = Callable[[F64], F64]


@dataclasses.dataclass(frozen=True, eq=False)
class CGResult:
    """Solution of a linear system, as far as it was taken."""

    x: F64  # (nodes, d)
    iterations: int
    has_converged: bool  # otherwise the limit of iterations ended it


def conjugate_gradients(
    multiply: Operator,
    precondition: Operator,
    right_side: F64,
    *,
    forcing: float,
    max_iterations: int,
    initial: F64 | None = None,
) -> CGResult:
    """Solve A x = b until the preconditioned residual has fallen to `forcing` times that of x = 0.

    Args:
        multiply: Returns A x, symmetric positive semidefinite.
        precondition: Returns M^-1 r, symmetric positive definite.
        right_side: b (nodes, d).
        forcing: Share of the residual that may be left.
        max_iterations: Largest number of products.
        initial: Where to begin; None = 0.

    Raises:
        NotPositiveDefinite: A has a direction without curvature, or an entry is not a number.
    """
    x, r = np.zeros_like(right_side), right_side.copy()
    z = precondition(r)
    rz = float(np.vdot(r, z))
    enough = forcing * forcing * rz
    if initial is not None:
        x = initial.copy()
        r = right_side - multiply(x)
        z = precondition(r)
        rz = float(np.vdot(r, z))
    p = z.copy()
    for iteration in range(max_iterations):
        if rz <= enough:
            return CGResult(x, iteration, has_converged=True)
        q = multiply(p)
        curvature = float(np.vdot(p, q))
        if not 0.0 < curvature < np.inf:
            raise NotPositiveDefinite(int(np.argmax(np.abs(p).max(axis=1))))
        step = rz / curvature
        x += step * p
        r -= step * q
        z = precondition(r)
        rz, last = float(np.vdot(r, z)), rz
        p *= rz / last
        p += z
    return CGResult(x, max_iterations, has_converged=rz <= enough)
