"""A ray caster in numpy, against which the compiled ray caster is compared.

It handles all pixels of an image at a time and box after box: plain, and thirty times slower.
"""

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F32, F64, I64
from maplab_py.geometry import so3
from maplab_py.simulation.scene import Scene, Textures
from maplab_py.simulation.shading_kernels import LEVELS

_TINY = np.float32(1e-9)


def render_slowly(scene: Scene, rays: F64, focal_px: float, T_G_C: F64) -> tuple[F32, F32]:
    """Return grey values (H, W) and depths (H, W) [m]; 0 where there is no ray.

    Args:
        scene: The boxes with their textures.
        rays: Points (H, W, 2) on the plane z = 1, NaN = no ray.
        focal_px: Focal length, which determines the footprint of a pixel.
        T_G_C: Pose (1, 7) of the camera, or (H, 7) at each row.
    """
    seen = np.isfinite(rays[..., 0])
    T_G_C = np.broadcast_to(T_G_C, (len(rays), 7))
    x = np.where(seen[..., None], rays, 0.0)
    ray_C = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2)
    direction = np.einsum("hij,hwj->hwi", so3.to_matrix(T_G_C[:, :4]), ray_C).astype(np.float32)
    eye = np.broadcast_to(T_G_C[:, None, 4:].astype(np.float32), direction.shape)
    d, e = direction[seen].T, eye[seen].T
    distance, surface = _cast(scene.boxes.astype(np.float32), e, d)
    image, depth = np.zeros(seen.shape, dtype=np.float32), np.zeros(seen.shape, dtype=np.float32)
    image[seen] = _shade(scene, e, d, distance, surface, focal_px)
    depth[seen] = distance
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
    axis, every = (surface % 6) // 2, np.arange(len(t))
    corner = scene.surfaces.corner.astype(np.float32)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    u_m = e[u, every] + t * d[u, every] - corner[surface, u]
    v_m = e[v, every] + t * d[v, every] - corner[surface, v]
    length = np.sqrt(np.einsum("in,in->n", d, d))
    slant = np.maximum(np.abs(d[axis, every]) / length, np.float32(0.05))
    footprint = t * length / (np.float32(focal_px) * np.sqrt(slant))
    return _sampled(scene.textures, surface, u_m, v_m, footprint)


def _sampled(textures: Textures, surface: I64, u_m: F32, v_m: F32, footprint_m: F32) -> F32:
    """Return grey values (N,): bilinear in the plane, linear between two levels."""
    texel = np.float32(textures.texel_m)
    level = np.clip(np.log2(np.maximum(footprint_m / texel, 1.0)), 0.0, LEVELS - 1.001)
    fine = level.astype(np.int64)
    share = level - fine.astype(np.float32)
    below = _bilinear(textures, surface, fine, u_m, v_m)
    above = _bilinear(textures, surface, fine + 1, u_m, v_m)
    return np.asarray(below + share * (above - below))


def _bilinear(textures: Textures, surface: I64, level: I64, u_m: F32, v_m: F32) -> F32:
    scale = (np.float32(1.0 / textures.texel_m) * np.float32(0.5) ** np.arange(LEVELS)).astype(
        np.float32
    )[level]
    right, bottom = textures.width[surface, level] - 1, textures.height[surface, level] - 1
    x = np.clip(u_m * scale - np.float32(0.5), 0, right.astype(np.float32))
    y = np.clip(v_m * scale - np.float32(0.5), 0, bottom.astype(np.float32))
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = x - column.astype(np.float32), y - row.astype(np.float32)
    to_right = column < right
    first = textures.offset[surface, level] + row * (right + 1) + column
    upper = _between(textures, first, to_right, fx)
    first += np.where(row < bottom, right + 1, 0)
    return np.asarray(upper + fy * (_between(textures, first, to_right, fx) - upper))


def _between(textures: Textures, first: I64, to_right: NDArray[np.bool_], share: F32) -> F32:
    left = textures.pixels[first].astype(np.float32)
    right = textures.pixels[first + to_right].astype(np.float32)
    return np.asarray(left + share * (right - left))
