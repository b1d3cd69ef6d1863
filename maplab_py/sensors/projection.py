"""Points to pixels and pixels to rays, with exact Jacobians, for every camera model of the format.

Parameters are ordered [intrinsics..., distortion...] as in `Camera`. Pinhole is the unified
projection (Mei 2007) with xi = 0: x = p / (z + xi |p|).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, Mask
from maplab_py.sensors import distortion
from maplab_py.sensors.camera import Camera, Projection

_MIN_DENOMINATOR = 1e-10
"""Smallest z + xi |p| [m] of a visible point."""


def project(camera: Camera, p_C: ArrayLike) -> tuple[F64, Mask]:
    """Return pixels (..., 2) of points (..., 3) and whether they are visible (...,).

    Visible means in front of the camera and inside the range where the distortion model is one
    to one; whether the pixel lies inside the image is `is_inside_image`. Pixels of points that
    are not visible are finite but without meaning.
    """
    uv, _, _, visible = project_with_jacobians(camera, p_C)
    return uv, visible


def project_with_jacobians(camera: Camera, p_C: ArrayLike) -> tuple[F64, F64, F64, Mask]:
    """Return pixels and their derivatives.

    Args:
        camera: Camera of n parameters.
        p_C: Points (..., 3) in the camera frame [m].

    Returns:
        uv (..., 2), d uv / d p_C (..., 2, 3), d uv / d parameters (..., 2, n), visible (...,).
        Values of points that are not visible are finite but without meaning.
    """
    p = np.asarray(p_C, dtype=np.float64)
    xi, focal, centre = _intrinsics(camera)
    x, length, denominator, visible = _normalised(camera, p)
    x = np.where(visible[..., None], x, 0.0)
    x_d, dx_d_dx, dx_d_dk = distortion.distort(camera.distortion, camera.distortion_parameters, x)

    # d denominator / d p = e_z + xi p / |p|
    slope = xi * p / np.where(length > 0.0, length, 1.0)[..., None]
    slope[..., 2] += 1.0
    dx_dp = (np.eye(2, 3) - x[..., :, None] * slope[..., None, :]) / denominator[..., None, None]
    duv_dx = focal[:, None] * dx_d_dx
    columns = [focal[:, None] * dx_d_dk]
    columns.insert(0, np.broadcast_to(np.eye(2), (*x.shape, 2)))
    columns.insert(0, x_d[..., :, None] * np.eye(2))
    if camera.projection is Projection.UNIFIED:
        dx_dxi = -x * (length / denominator)[..., None]
        columns.insert(0, duv_dx @ dx_dxi[..., None])
    return focal * x_d + centre, duv_dx @ dx_dp, np.concatenate(columns, axis=-1), visible


def visibility_limits(camera: Camera) -> F64:
    """Return what tells visible points p_C, as `project` does: xi, least depth, cone, and radius (4,).

    Visible are points with z + xi |p| > least depth, z > -cone |p|, and |(x, y)| < radius (z + xi |p|).
    """
    xi = _intrinsics(camera)[0]
    radius = distortion.largest_radius(camera.distortion, camera.distortion_parameters)
    return np.array([xi, _MIN_DENOMINATOR, _cone(xi), radius])


def back_project(camera: Camera, uv: ArrayLike) -> tuple[F64, Mask]:
    """Return unit rays (..., 3) in the camera frame of pixels (..., 2), and whether they exist.

    A pixel outside the image of the model, or one whose iterative undistortion did not converge,
    is not valid and gets the optical axis.
    """
    xi, focal, centre = _intrinsics(camera)
    x_d = (np.asarray(uv, dtype=np.float64) - centre) / focal
    finite = np.all(np.isfinite(x_d), axis=-1)
    x_d = np.where(finite[..., None], x_d, 0.0)
    x, valid = distortion.undistort(camera.distortion, camera.distortion_parameters, x_d)
    r2 = np.sum(x * x, axis=-1)
    # Mei 2007, eq. (5): the sphere point whose projection from (0, 0, -xi) is x
    discriminant = 1.0 + (1.0 - xi * xi) * r2
    valid = valid & finite & (discriminant >= 0.0)
    scale = (xi + np.sqrt(np.maximum(discriminant, 0.0))) / (1.0 + r2)
    ray = np.concatenate([scale[..., None] * x, (scale - xi)[..., None]], axis=-1)
    ray = np.where(valid[..., None], ray, np.array([0.0, 0.0, 1.0]))
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid


def is_inside_image(camera: Camera, uv: ArrayLike, margin_px: float = 0.0) -> Mask:
    """Tell which pixels (..., 2) lie inside the image, at least `margin_px` from its border."""
    pixels = np.asarray(uv, dtype=np.float64)
    size = np.array([camera.width_px, camera.height_px])
    inside = (pixels >= margin_px) & (pixels < size - margin_px)
    return np.asarray(np.all(inside, axis=-1))


def _intrinsics(camera: Camera) -> tuple[float, F64, F64]:
    """Return xi, focal lengths (2,) and principal point (2,)."""
    values = np.asarray(camera.intrinsics, dtype=np.float64)
    if camera.projection is Projection.UNIFIED:
        return float(values[0]), values[1:3], values[3:5]
    return 0.0, values[:2], values[2:4]


def _normalised(camera: Camera, p: F64) -> tuple[F64, F64, F64, Mask]:
    """Return x (..., 2), |p|, z + xi |p| (1 where not positive), and which points are visible."""
    xi = _intrinsics(camera)[0]
    length = np.linalg.norm(p, axis=-1)
    denominator = p[..., 2] + xi * length
    visible = (denominator > _MIN_DENOMINATOR) & (p[..., 2] > -_cone(xi) * length)
    denominator = np.where(visible, denominator, 1.0)
    x = p[..., :2] / denominator[..., None]
    limit = distortion.largest_radius(camera.distortion, camera.distortion_parameters)
    return x, length, denominator, visible & (np.linalg.norm(x, axis=-1) < limit)


def _cone(xi: float) -> float:
    """Return the cosine bound of visible points: z > -cone |p|."""
    return 1.0 / xi if xi > 1.0 else xi
