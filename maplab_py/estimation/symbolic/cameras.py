"""Camera models as casadi functions of a few numbers, differentiated exactly.

All projections divide x and y of a point by D(p), after which a distortion follows; formulas and sources
are those of `sensors.projection` and `sensors.distortion`.
"""

from typing import Any

import casadi

from maplab_py.sensors.camera import DISTORTION_SIZE, MIRROR_NAMES, Distortion, Projection

ca: Any = casadi  # its stubs do not know mixed arguments
SX = Any

_EPSILON = 1e-20
"""Added to r^2: all models are even in r, so this changes no digit, and r = 0 is harmless."""


def denominator(projection: Projection) -> Any:
    """Return f(p_C, mirror) -> D (1), its derivatives by p_C (1 x 3) and by the mirror's parameters."""
    p, m = ca.SX.sym("p", 3), ca.SX.sym("m", len(MIRROR_NAMES[projection]))
    depth, square = p[2], p[0] * p[0] + p[1] * p[1]
    if projection in (Projection.UNIFIED, Projection.DOUBLE_SPHERE):
        depth = depth + m[0] * ca.sqrt(ca.dot(p, p))
    if projection is Projection.DOUBLE_SPHERE:
        depth = m[1] * ca.sqrt(square + depth * depth) + (1 - m[1]) * depth
    if projection is Projection.EXTENDED_UNIFIED:
        depth = m[0] * ca.sqrt(m[1] * square + depth * depth) + (1 - m[0]) * depth
    return _with_derivatives(depth, p, m)


def distort(distortion: Distortion) -> Any:
    """Return f(x, k) -> distorted place (2) of a point x (2) of the plane z = 1, and by x, by k."""
    x, k = ca.SX.sym("x", 2), ca.SX.sym("k", DISTORTION_SIZE[distortion])
    return _with_derivatives(_distorted(distortion, x, k), x, k)


def _distorted(distortion: Distortion, x: SX, k: SX) -> SX:
    if distortion is Distortion.NONE:
        return x
    r2 = ca.dot(x, x)
    if distortion in (Distortion.RADTAN, Distortion.RADTAN5, Distortion.RATIONAL):
        radial = 1 + k[0] * r2 + k[1] * r2 * r2
        if distortion is not Distortion.RADTAN:
            radial = radial + k[4] * r2 * r2 * r2
        if distortion is Distortion.RATIONAL:
            radial = radial / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        across = 2 * x[0] * x[1]
        u = k[2] * across + k[3] * (r2 + 2 * x[0] * x[0])
        v = k[3] * across + k[2] * (r2 + 2 * x[1] * x[1])
        return x * radial + ca.vertcat(u, v)
    r = ca.sqrt(r2 + _EPSILON)
    if distortion is Distortion.EQUIDISTANT:
        theta = ca.atan(r)
        t2 = theta * theta
        polynomial = 1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))
        return x * (theta * polynomial / r)
    return x * (ca.atan(2 * r * ca.tan(0.5 * k[0])) / (k[0] * r))


def _with_derivatives(value: SX, point: SX, parameters: SX) -> Any:
    results = [value, ca.jacobian(value, point), ca.jacobian(value, parameters)]
    dense = ca.cse([ca.densify(result) for result in results])
    return ca.Function("camera", [point, parameters], dense)
