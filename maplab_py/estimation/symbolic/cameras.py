"""Camera models as casadi expressions; the formulas of `sensors.projection`, differentiated exactly.

Sources: radtan and rational, Brown 1966 as in OpenCV; equidistant, Kannala and Brandt 2006; FOV,
Devernay and Faugeras 2001; projections as in `sensors.projection`.
"""

from __future__ import annotations

from typing import Any

import casadi

from maplab_py.sensors.camera import INTRINSICS_SIZE, Distortion, Projection

ca: Any = casadi  # its stubs do not know mixed arguments
SX = Any

_EPSILON = 1e-20
"""Added to r^2: all models are even in r, so this changes no digit, and r = 0 is harmless."""


def distort(distortion: Distortion, x: SX, y: SX, k: SX) -> tuple[SX, SX]:
    """Take a point of the plane z = 1 to its distorted place."""
    if distortion is Distortion.NONE:
        return x, y
    r2 = x * x + y * y
    if distortion in (Distortion.RADTAN, Distortion.RADTAN5, Distortion.RATIONAL):
        radial = 1 + k[0] * r2 + k[1] * r2 * r2
        if distortion is not Distortion.RADTAN:
            radial = radial + k[4] * r2 * r2 * r2
        if distortion is Distortion.RATIONAL:
            radial = radial / (1 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])))
        return (
            x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x),
            y * radial + 2 * k[3] * x * y + k[2] * (r2 + 2 * y * y),
        )
    r = ca.sqrt(r2 + _EPSILON)
    if distortion is Distortion.EQUIDISTANT:
        theta = ca.atan(r)
        t2 = theta * theta
        polynomial = 1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))
        scale = theta * polynomial / r
    else:
        scale = ca.atan(2 * r * ca.tan(0.5 * k[0])) / (k[0] * r)
    return x * scale, y * scale


def denominator(projection: Projection, p_C: SX, intrinsics: SX) -> SX:
    """Return what x and y of a point are divided by."""
    depth, square = p_C[2], p_C[0] * p_C[0] + p_C[1] * p_C[1]
    if projection in (Projection.UNIFIED, Projection.DOUBLE_SPHERE):
        depth = depth + intrinsics[0] * ca.sqrt(ca.dot(p_C, p_C))
    if projection is Projection.DOUBLE_SPHERE:
        alpha = intrinsics[1]
        return alpha * ca.sqrt(square + depth * depth) + (1 - alpha) * depth
    if projection is Projection.EXTENDED_UNIFIED:
        alpha, beta = intrinsics[0], intrinsics[1]
        return alpha * ca.sqrt(beta * square + depth * depth) + (1 - alpha) * depth
    return depth


def project(projection: Projection, distortion: Distortion, p_C: SX, parameters: SX) -> SX:
    """Return the pixel of a point; parameters are [intrinsics, distortion]."""
    count = INTRINSICS_SIZE[projection]
    intrinsics, k = parameters[:count], parameters[count:]
    depth = denominator(projection, p_C, intrinsics)
    x, y = distort(distortion, p_C[0] / depth, p_C[1] / depth, k)
    fu, fv, cu, cv = (intrinsics[count - 4 + i] for i in range(4))
    return ca.vertcat(fu * x + cu, fv * y + cv)
