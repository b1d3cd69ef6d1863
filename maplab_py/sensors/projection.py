"""Points to pixels and pixels to rays, for every camera model of the format.

Parameters are ordered [intrinsics..., distortion...] as in `Camera`. All projections have the form
x = p / D(p):

    unified (Mei and Rives 2007)              D = z + xi |p|; xi = 0 is the pinhole camera
    double sphere (Usenko et al. 2018)        D = alpha |(x, y, k)| + (1 - alpha) k, k = z + xi |p|
    extended unified (Khomutenko et al. 2016) D = alpha sqrt(beta (x^2 + y^2) + z^2) + (1 - alpha) z
"""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, Mask
from maplab_py.sensors import distortion
from maplab_py.sensors.camera import Camera, Projection

_MIN_DENOMINATOR = 1e-10
"""Smallest D(p) [m] of a visible point."""


def project(camera: Camera, p_C: ArrayLike) -> tuple[F64, Mask]:
    """Return pixels (..., 2) of points (..., 3) and whether they are visible (...,).

    Visible means in front of the camera and inside the range where the distortion model is one
    to one; whether the pixel lies inside the image is `is_inside_image`. Pixels of points that
    are not visible are finite but without meaning.
    """
    _, focal, centre = _intrinsics(camera)
    x, visible = _normalise(camera, np.asarray(p_C, dtype=np.float64))
    x = np.where(visible[..., None], x, 0.0)
    x_d = distortion.distort(camera.distortion, camera.distortion_parameters, x)
    return focal * x_d + centre, visible


def visibility_limits(camera: Camera) -> F64:
    """Return what tells visible points p_C, as `project` does: shift, least depth, cone, and radius (4,).

    Visible are points with z + shift |p| > least depth, z > -cone |p|, and
    |(x, y)| < radius (z + shift |p|); where a model has no such radius, the first two say the same.
    """
    mirror, cone = _intrinsics(camera)[0], _cone(camera)
    radius = distortion.largest_radius(camera.distortion, camera.distortion_parameters)
    shift = mirror[0] if camera.projection is Projection.UNIFIED else cone
    return np.array([shift, _MIN_DENOMINATOR, cone, radius])


def back_project(camera: Camera, uv: ArrayLike) -> tuple[F64, Mask]:
    """Return unit rays (..., 3) in the camera frame of pixels (..., 2), and whether they exist.

    A pixel outside the image of the model, or one whose iterative undistortion did not converge,
    is not valid and gets the optical axis.
    """
    mirror, focal, centre = _intrinsics(camera)
    x_d = (np.asarray(uv, dtype=np.float64) - centre) / focal
    finite = np.all(np.isfinite(x_d), axis=-1)
    x_d = np.where(finite[..., None], x_d, 0.0)
    x, valid = distortion.undistort(camera.distortion, camera.distortion_parameters, x_d)
    ray, exists = _BACK[camera.projection](mirror, x)
    valid = valid & finite & exists
    ray = np.where(valid[..., None], ray, np.array([0.0, 0.0, 1.0]))
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True), valid


def is_inside_image(camera: Camera, uv: ArrayLike, margin_px: float = 0.0) -> Mask:
    """Tell which pixels (..., 2) lie inside the image, at least `margin_px` from its border."""
    pixels = np.asarray(uv, dtype=np.float64)
    size = np.array([camera.width_px, camera.height_px])
    inside = (pixels >= margin_px) & (pixels < size - margin_px)
    return np.asarray(np.all(inside, axis=-1))


def _intrinsics(camera: Camera) -> tuple[tuple[float, ...], F64, F64]:
    """Return the parameters before the focal lengths, focal lengths (2,) and principal point (2,)."""
    values = np.asarray(camera.intrinsics, dtype=np.float64)
    return tuple(values[:-4].tolist()), values[-4:-2], values[-2:]


def _normalise(camera: Camera, p: F64) -> tuple[F64, Mask]:
    """Return x (..., 2) and which points are visible (...,)."""
    limit = distortion.largest_radius(camera.distortion, camera.distortion_parameters)
    with np.errstate(over="ignore", invalid="ignore"):  # no camera sees points beyond 1e154 m
        length = np.linalg.norm(p, axis=-1)
        denominator = _denominator(camera.projection, _intrinsics(camera)[0], p, length)
        visible = (denominator > _MIN_DENOMINATOR) & (p[..., 2] > -_cone(camera) * length)
        denominator = np.where(visible, denominator, 1.0)
        x = p[..., :2] / denominator[..., None]
        return x, visible & (np.linalg.norm(x, axis=-1) < limit)


def _denominator(projection: Projection, mirror: tuple[float, ...], p: F64, length: F64) -> F64:
    """Return D(p) (...,) of points (..., 3) and their distances (...,)."""
    z, square = p[..., 2], p[..., 0] ** 2 + p[..., 1] ** 2
    if projection is Projection.DOUBLE_SPHERE:
        xi, alpha = mirror
        k = z + xi * length
        return np.asarray(alpha * np.sqrt(square + k * k) + (1.0 - alpha) * k)
    if projection is Projection.EXTENDED_UNIFIED:
        alpha, beta = mirror
        return np.asarray(alpha * np.sqrt(beta * square + z * z) + (1.0 - alpha) * z)
    return np.asarray(z + mirror[0] * length if mirror else z)


def _cone(camera: Camera) -> float:
    """Return the cosine bound of points whose projection is one to one: z > -cone |p|."""
    mirror = _intrinsics(camera)[0]
    if camera.projection in (Projection.PINHOLE, Projection.UNIFIED):
        xi = mirror[0] if mirror else 0.0
        return 1.0 / xi if xi > 1.0 else xi
    first, second = mirror
    alpha = second if camera.projection is Projection.DOUBLE_SPHERE else first
    bound = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    if camera.projection is Projection.EXTENDED_UNIFIED:  # z > -bound sqrt(beta (x^2 + y^2) + z^2)
        ratio = second * bound * bound
        return float(np.sqrt(ratio / (1.0 - bound * bound + ratio)))
    # k > -bound |(x, y, k)|: exact, where Usenko et al., eq. (43)-(45), give a smaller bound
    root = np.sqrt(1.0 - first * first * (1.0 - bound * bound))
    return float(first + bound * (root - bound * first))


def _unified_ray(mirror: tuple[float, ...], x: F64) -> tuple[F64, Mask]:
    """Return rays and whether they exist; Mei 2007, eq. (5): the sphere point seen from (0, 0, -xi)."""
    xi, r2 = mirror[0] if mirror else 0.0, np.sum(x * x, axis=-1)
    discriminant = 1.0 + (1.0 - xi * xi) * r2
    scale = (xi + np.sqrt(np.maximum(discriminant, 0.0))) / (1.0 + r2)
    ray = np.concatenate([scale[..., None] * x, (scale - xi)[..., None]], axis=-1)
    return ray, discriminant >= 0.0


def _double_sphere_ray(mirror: tuple[float, ...], x: F64) -> tuple[F64, Mask]:
    """Return rays and whether they exist; Usenko et al. 2018, eq. (46)-(51)."""
    xi, alpha = mirror
    r2 = np.sum(x * x, axis=-1)
    z, exists = _sphere_depth(alpha, 1.0, r2)
    discriminant = z * z + (1.0 - xi * xi) * r2
    scale = (z * xi + np.sqrt(np.maximum(discriminant, 0.0))) / (z * z + r2)
    ray = np.concatenate([scale[..., None] * x, (scale * z - xi)[..., None]], axis=-1)
    return ray, exists & (discriminant >= 0.0)


def _extended_unified_ray(mirror: tuple[float, ...], x: F64) -> tuple[F64, Mask]:
    """Return rays and whether they exist; Khomutenko et al. 2016, eq. (23)."""
    alpha, beta = mirror
    z, exists = _sphere_depth(alpha, beta, np.sum(x * x, axis=-1))
    return np.concatenate([x, z[..., None]], axis=-1), exists


def _sphere_depth(alpha: float, beta: float, r2: F64) -> tuple[F64, Mask]:
    """Return z with alpha sqrt(beta r^2 + z^2) + (1 - alpha) z = 1, and whether it exists."""
    discriminant = 1.0 - (2.0 * alpha - 1.0) * beta * r2
    below = alpha * np.sqrt(np.maximum(discriminant, 0.0)) + 1.0 - alpha
    exists = (discriminant >= 0.0) & (below > 0.0)
    return (1.0 - alpha * alpha * beta * r2) / np.where(exists, below, 1.0), exists


_BACK = {
    Projection.PINHOLE: _unified_ray,
    Projection.UNIFIED: _unified_ray,
    Projection.DOUBLE_SPHERE: _double_sphere_ray,
    Projection.EXTENDED_UNIFIED: _extended_unified_ray,
}
