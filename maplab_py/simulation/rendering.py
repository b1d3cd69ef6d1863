"""Images and depth of a world, cast ray by ray through the true camera model."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.simulation.cameras import pixels_of
from maplab_py.simulation.surfaces import Surfaces, box_surfaces, join
from maplab_py.simulation.textures import Textures, make_textures

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_NEWTON_ROUNDS = 30
_LARGEST_RADIUS = 5.0
"""Pixels that look further aside than this (79 deg) stay black."""
_THINNEST_M = 5e-4
"""Half the thickness of the thinnest wall that single precision does not look through."""
_TINY = np.float32(1e-9)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Boxes with painted sides. Box 0 is the space that is seen from inside.

    Side s of box b is surface 6 b + s, in the order of `box_surfaces`.
    """

    boxes: F64  # (B, 2, 3)
    surfaces: Surfaces  # (6 B)
    textures: Textures


def make_scene(bounds: F64, boxes: F64, texel_m: float, rng: np.random.Generator) -> Scene:
    """Paint the sides of a space (2, 3) and of the boxes (B, 2, 3) in it."""
    middle, half = boxes.mean(axis=1), 0.5 * np.diff(boxes, axis=1)[:, 0]
    half = np.maximum(half, _THINNEST_M)
    every = np.concatenate([bounds[None], np.stack([middle - half, middle + half], axis=1)])
    sides = [box_surfaces(b[0], b[1], inwards=row == 0) for row, b in enumerate(every)]
    surfaces = join(sides)
    return Scene(every, surfaces, make_textures(surfaces, texel_m, rng))


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
    # begins near the centre, where all models are nearly linear, and walks outwards
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


def render(scene: Scene, rays: F64, focal_px: float, T_G_C: F64) -> tuple[F32, F32]:
    """Cast the rays of an image.

    Args:
        scene: What is to be seen.
        rays: Points (H, W, 2) on the plane z = 1, NaN = black.
        focal_px: Gives the size of a pixel on a surface.
        T_G_C: Pose (H, 7) of the camera at each row.

    Returns:
        Grey values (H, W) in 0 .. 255 and depths along z (H, W) [m]; 0 where there is no ray.
    """
    seen = np.isfinite(rays[..., 0])
    x = np.where(seen[..., None], rays, 0.0)
    R = so3.to_matrix(T_G_C[:, :4])
    ray_C = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2)
    direction = np.einsum("hij,hwj->hwi", R, ray_C, optimize=True).astype(np.float32)
    eye = np.broadcast_to(T_G_C[:, None, 4:].astype(np.float32), direction.shape)
    # one plane per axis, contiguous
    d = np.ascontiguousarray(direction[seen].T)
    e = np.ascontiguousarray(eye[seen].T)
    depth_of, surface = _cast(scene.boxes.astype(np.float32), e, d)
    grey = _shade(scene, e, d, depth_of, surface, focal_px)
    image, depth = np.zeros(seen.shape, dtype=np.float32), np.zeros(seen.shape, dtype=np.float32)
    image[seen], depth[seen] = grey, depth_of
    return image, depth


def _cast(boxes: F32, e: F32, d: F32) -> tuple[F32, I64]:
    """Return where rays e + t d (3, N) first hit: t (N,) and the surface (N,)."""
    inverse = 1.0 / np.where(np.abs(d) < _TINY, _TINY, d)
    forward = d > 0.0
    ahead = np.where(forward, boxes[0, 1, :, None], boxes[0, 0, :, None])
    leave = (ahead - e) * inverse
    axis = np.argmin(leave, axis=0)
    every = np.arange(d.shape[1])
    best = leave[axis, every]
    surface = 2 * axis + forward[axis, every]
    for number, (low, high) in enumerate(boxes[1:], start=1):
        a, b = (low[:, None] - e) * inverse, (high[:, None] - e) * inverse
        near = np.minimum(a, b)
        enter = near.max(axis=0)
        hit = (enter < np.maximum(a, b).min(axis=0)) & (enter > 0.0) & (enter < best)
        rows = np.flatnonzero(hit)
        if len(rows):
            along = np.argmax(near[:, rows], axis=0)
            best[rows] = enter[rows]
            surface[rows] = 6 * number + 2 * along + ~forward[along, rows]
    return best, surface


def _shade(scene: Scene, e: F32, d: F32, t: F32, surface: I64, focal_px: float) -> F32:
    """Return the grey values (N,) of the places that were hit."""
    count = len(t)
    axis = (surface % 6) // 2
    corner = scene.surfaces.corner.astype(np.float32).ravel()
    # flat indices gather several times faster than pairs
    every = np.arange(count)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    along = u * count + every
    u_m = e.take(along) + t * d.take(along) - corner.take(3 * surface + u)
    along = v * count + every
    v_m = e.take(along) + t * d.take(along) - corner.take(3 * surface + v)
    length = np.sqrt(np.einsum("in,in->n", d, d))
    slant = np.maximum(np.abs(d.take(axis * count + every)) / length, np.float32(0.05))
    footprint = t * length / (np.float32(focal_px) * np.sqrt(slant))
    return scene.textures.sample(surface, u_m, v_m, footprint)
