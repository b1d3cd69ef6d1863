"""Projection for the simulator, independent of the estimator's so that tests can compare both."""

import numpy as np

from maplab_py.array_types import F64
from maplab_py.sensors import Camera, Distortion, Projection

_LARGEST_RADIUS = 6.0
"""Normalised radius up to which a distortion is searched for its turning point."""


def pixels_of(camera: Camera, p_C: F64) -> F64:
    """Return pixels (N, 2) of points (N, 3) that lie in front of the camera."""
    values = camera.intrinsics
    depth, distance = p_C[:, 2], np.sqrt(np.einsum("ij,ij->i", p_C, p_C))
    if camera.projection is Projection.UNIFIED:
        depth = depth + values[0] * distance
    elif camera.projection is Projection.DOUBLE_SPHERE:
        # Usenko, Demmel and Cremers (2018), eq. (40)
        shifted = depth + values[0] * distance
        second = np.sqrt(np.sum(p_C[:, :2] ** 2, axis=1) + shifted**2)
        depth = values[1] * second + (1.0 - values[1]) * shifted
    elif camera.projection is Projection.EXTENDED_UNIFIED:
        # Khomutenko, Garcia and Martinet (2016), eq. (5)
        scaled = np.sqrt(values[1] * np.sum(p_C[:, :2] ** 2, axis=1) + depth**2)
        depth = values[0] * scaled + (1.0 - values[0]) * depth
    values = values[-4:]
    x = _distort(camera, p_C[:, 0] / depth, p_C[:, 1] / depth)
    return np.stack([values[0] * x[0] + values[2], values[1] * x[1] + values[3]], axis=1)


def field_of_view_radius(camera: Camera) -> float:
    """Return the normalised radius |x| / z inside which the image moves outwards with the point."""
    radius = np.linspace(1e-3, _LARGEST_RADIUS, 4000)
    image = np.hypot(*_distort(camera, radius, np.zeros_like(radius)))
    backwards = np.flatnonzero(np.diff(image) <= 0.0)
    return float(radius[backwards[0]]) if len(backwards) else _LARGEST_RADIUS


def _distort(camera: Camera, x: F64, y: F64) -> tuple[F64, F64]:
    k = camera.distortion_parameters
    r2 = x * x + y * y
    if camera.distortion in (Distortion.RADTAN, Distortion.RADTAN5, Distortion.RATIONAL):
        # Brown (1966): radial and decentring terms; rational as in OpenCV's documentation
        k3, k4, k5, k6 = np.append(k[4:], np.zeros(8 - len(k))) if len(k) < 8 else k[4:]
        radial = 1.0 + r2 * (k[0] + r2 * (k[1] + r2 * k3))
        radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (
            x * radial + 2.0 * k[2] * x * y + k[3] * (r2 + 2.0 * x * x),
            y * radial + 2.0 * k[3] * x * y + k[2] * (r2 + 2.0 * y * y),
        )
    if camera.distortion is Distortion.NONE:
        return x, y
    r = np.maximum(np.sqrt(r2), 1e-12)
    if camera.distortion is Distortion.FOV:
        # Devernay and Faugeras (2001), eq. (13)
        image = np.arctan(2.0 * r * np.tan(0.5 * k[0])) / k[0]
    else:
        # Kannala and Brandt (2006), eq. (6)
        angle = np.arctan(r)
        a2 = angle * angle
        image = angle * (1.0 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
    return x * image / r, y * image / r
