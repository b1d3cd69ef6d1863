"""Rays of the pixels of a camera: the inverse of its projection."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.sensors import Camera
from maplab_py.simulation.cameras import pixels_of

_NEWTON_ROUNDS = 30
_LARGEST_RADIUS = 5.0
"""Pixels with a larger angle to the optical axis (79 deg) are black."""


def pixel_rays(camera: Camera) -> F64:
    """Return the points (H, W, 2) on the plane z = 1 that the pixel centres show; NaN = none.

    The projection is inverted by Newton's method with numeric derivatives.

    Raises:
        UserError: No pixel has a ray.
    """
    v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
    wanted = np.stack([u.ravel(), v.ravel()], axis=1)
    focal, centre = camera.intrinsics[-4:-2], camera.intrinsics[-2:]
    offset = (wanted - centre) / focal
    # starts near the centre, where all models are nearly linear, and proceeds outwards
    x = offset / (1.0 + 0.3 * np.sum(offset**2, axis=1, keepdims=True))
    step = 1e-6
    step_u, step_v = np.array([step, 0.0]), np.array([0.0, step])
    for _ in range(_NEWTON_ROUNDS):
        here = _project(camera, x)
        miss = wanted - here
        if np.abs(miss).max() < 1e-9:
            break
        du = (_project(camera, x + step_u) - here) / step
        dv = (_project(camera, x + step_v) - here) / step
        determinant = du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0]
        determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
        move = np.stack(
            [
                (miss[:, 0] * dv[:, 1] - miss[:, 1] * dv[:, 0]) / determinant,
                (miss[:, 1] * du[:, 0] - miss[:, 0] * du[:, 1]) / determinant,
            ],
            axis=1,
        )
        length = np.linalg.norm(move, axis=1, keepdims=True)
        x = x + move * np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
    lost = np.linalg.norm(_project(camera, x) - wanted, axis=1) > 1e-6
    lost |= np.linalg.norm(x, axis=1) > _LARGEST_RADIUS
    if lost.all():
        raise UserError("cameras: no pixel of the image can be inverted to a ray")
    x[lost] = np.nan
    return np.asarray(x.reshape(camera.height_px, camera.width_px, 2))


def _project(camera: Camera, x: F64) -> F64:
    return pixels_of(camera, np.concatenate([x, np.ones((len(x), 1))], axis=1))
