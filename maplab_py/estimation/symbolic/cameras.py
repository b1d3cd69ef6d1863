"""Camera models as casadi expressions; the formulas of `sensors.projection`, differentiated exactly.

Sources: radtan, Brown 1966 as in OpenCV; equidistant, Kannala and Brandt 2006; FOV, Devernay and
Faugeras 2001; unified projection, Mei and Rives 2007.
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
    if distortion is Distortion.RADTAN:
        radial = 1 + k[0] * r2 + k[1] * r2 * r2
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


def project(projection: Projection, distortion: Distortion, p_C: SX, parameters: SX) -> SX:
    """Return the pixel of a point; parameters are [intrinsics, distortion]."""
    count = INTRINSICS_SIZE[projection]
    intrinsics, k = parameters[:count], parameters[count:]
    depth = p_C[2]
    if projection is Projection.UNIFIED:
        depth = depth + intrinsics[0] * ca.sqrt(ca.dot(p_C, p_C))
    x, y = distort(distortion, p_C[0] / depth, p_C[1] / depth, k)
    fu, fv, cu, cv = (intrinsics[count - 4 + i] for i in range(4))
    return ca.vertcat(fu * x + cu, fv * y + cv)
