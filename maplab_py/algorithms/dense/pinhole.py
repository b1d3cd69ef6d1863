"""Perspective images without distortion, and depth maps carried between them and real cameras."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from maplab_py.array_types import F32, F64, Mask
from maplab_py.sensors import Camera, projection

_MAX_TANGENT = 1.6
"""Largest tangent of the angle between a ray of a perspective image and its axis (58 degrees)."""
_BORDER_SAMPLES = 64
_UNKNOWN_M = -1e6
"""Stands for unknown depths in an interpolation: even a small part of it makes the result impossible."""
_MAX_STEP = 0.05
"""Largest relative difference between a depth and its interpolation; beyond lies an edge."""


@dataclasses.dataclass(frozen=True)
class Pinhole:
    """An ideal perspective camera with equal focal lengths."""

    focal_px: float
    centre_px: tuple[float, float]
    width_px: int
    height_px: int

    def rays(self) -> F64:
        """Return the points (H, W, 3) at depth 1 of all pixels."""
        u, v = np.meshgrid(np.arange(self.width_px), np.arange(self.height_px))
        x = (u - self.centre_px[0]) / self.focal_px
        y = (v - self.centre_px[1]) / self.focal_px
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def pixels(self, p: F64) -> tuple[F32, F32, Mask]:
        """Return u and v (...,) of points (..., 3), and which are in front of the camera."""
        visible = p[..., 2] > 1e-6
        z = np.where(visible, p[..., 2], 1.0)
        u = self.focal_px * p[..., 0] / z + self.centre_px[0]
        v = self.focal_px * p[..., 1] / z + self.centre_px[1]
        return u.astype(np.float32), v.astype(np.float32), visible


def inscribed(views: list[tuple[Camera, F64]], width_px: int, height_px: int) -> Pinhole:
    """Return the perspective camera with the largest view that all cameras share.

    All its pixels lie inside the image of every camera, as with OpenCV's stereoRectify and alpha = 0,
    unless a lens is wider than a perspective image can show.

    Args:
        views: Cameras with the rotations R_P_C (3, 3) to the frame P of the perspective camera.
        width_px: Width of its images.
        height_px: Height of its images.
    """
    low, high = np.full(2, -_MAX_TANGENT), np.full(2, _MAX_TANGENT)
    steps = np.linspace(0.0, 1.0, _BORDER_SAMPLES)[:, None]
    for camera, R_P_C in views:
        size = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
        for axis in range(2):
            for side in range(2):
                edge = np.empty((_BORDER_SAMPLES, 2))
                edge[:, 1 - axis] = steps[:, 0] * size[1 - axis]
                edge[:, axis] = side * size[axis]
                rays, valid = projection.back_project(camera, edge)
                rays = rays[valid] @ R_P_C.T
                rays = rays[rays[:, 2] > 0.1]
                if not len(rays):
                    continue  # the lens shows more than half a turn on this side
                x = rays[:, :2] / rays[:, 2:]
                across = x.mean(axis=0)
                main = int(np.argmax(np.abs(across)))
                if across[main] < 0.0:
                    low[main] = max(low[main], float(x[:, main].max()))
                else:
                    high[main] = min(high[main], float(x[:, main].min()))
    size = np.array([width_px, height_px])
    focal = float(np.max(size / np.maximum(high - low, 1e-3)))
    centre = 0.5 * (size - 1.0) - focal * 0.5 * (low + high)
    return Pinhole(focal, (float(centre[0]), float(centre[1])), width_px, height_px)


@dataclasses.dataclass(frozen=True, eq=False)
class ImageMap:
    """Map from the pixels of an image to those of another one; -1 where it is not seen there."""

    u: F32  # (H, W)
    v: F32  # (H, W)

    @classmethod
    def of(cls, u: F32, v: F32, valid: Mask) -> ImageMap:
        """Return the map with -1 where pixels are not valid."""
        return cls(
            np.where(valid, u, -1.0).astype(np.float32), np.where(valid, v, -1.0).astype(np.float32)
        )

    @property
    def valid(self) -> Mask:
        """Mask of the pixels that are seen."""
        return np.asarray(self.u >= 0.0)

    def image(self, pixels: Any) -> Any:
        """Return an image (H, W[, 3]) at these pixels, interpolated."""
        import cv2

        return cv2.remap(pixels, self.u, self.v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def depth(self, depth: F32) -> F32:
        """Return the depths (H, W) at these pixels; 0 where they are not known.

        They are interpolated on surfaces and taken from the nearest pixel at edges.
        """
        import cv2

        constant = cv2.BORDER_CONSTANT
        nearest = cv2.remap(
            depth, self.u, self.v, cv2.INTER_NEAREST, borderMode=constant, borderValue=0.0
        )
        marked = np.where(depth > 0.0, depth, np.float32(_UNKNOWN_M))
        linear = cv2.remap(
            marked, self.u, self.v, cv2.INTER_LINEAR, borderMode=constant, borderValue=_UNKNOWN_M
        )
        is_surface = np.abs(linear - nearest) < _MAX_STEP * nearest
        return np.asarray(np.where(is_surface, linear, nearest), dtype=np.float32)


def map_to_camera(pinhole: Pinhole, camera: Camera, R_C_P: F64) -> ImageMap:
    """Return where the pixels of a perspective image lie in a camera's distorted image."""
    uv, visible = projection.project(camera, pinhole.rays() @ R_C_P.T)
    visible = visible & projection.is_inside_image(camera, uv)
    return ImageMap.of(uv[..., 0], uv[..., 1], visible)  # type: ignore[arg-type]


def map_from_camera(pinhole: Pinhole, camera: Camera, R_C_P: F64) -> tuple[ImageMap, F32]:
    """Return where the pixels of a camera's distorted image lie in a perspective image.

    Returns:
        The map, and the factors (H, W) by which a depth along the axis of the perspective camera
        becomes one along the axis of the camera.
    """
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays, valid = projection.back_project(camera, np.stack([u, v], axis=-1))
    p_P = rays @ R_C_P
    u_P, v_P, in_front = pinhole.pixels(p_P)
    inside = (u_P >= 0) & (v_P >= 0) & (u_P < pinhole.width_px) & (v_P < pinhole.height_px)
    seen = valid & in_front & inside & (rays[..., 2] > 0.0)
    factor = np.where(seen, rays[..., 2] / np.where(seen, p_P[..., 2], 1.0), 0.0)
    return ImageMap.of(u_P, v_P, seen), factor.astype(np.float32)


def undistorted(camera: Camera) -> tuple[Pinhole, ImageMap]:
    """Return a perspective camera on the same axis that sees all of a camera's image, and its map.

    The image is cut off where a ray is further from the axis than a perspective image can show. The focal
    length is that of the perspective image of the same size inside the camera's image.
    """
    focal = inscribed([(camera, np.eye(3))], camera.width_px, camera.height_px).focal_px
    size = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    steps = np.linspace(0.0, 1.0, _BORDER_SAMPLES)
    ends = np.zeros_like(steps)
    border = np.concatenate(
        [
            np.stack(pair, axis=1)
            for pair in ((steps, ends), (steps, ends + 1.0), (ends, steps), (ends + 1.0, steps))
        ]
    )
    rays, valid = projection.back_project(camera, border * size)
    x = rays[:, :2] / np.maximum(rays[:, 2:], 1e-3)
    x = np.where(valid[:, None], np.clip(x, -_MAX_TANGENT, _MAX_TANGENT), 0.0)
    low, high = x.min(axis=0), x.max(axis=0)
    width, height = (np.ceil(focal * (high - low)) + 1.0).astype(int).tolist()
    centre = -focal * low
    pinhole = Pinhole(focal, (float(centre[0]), float(centre[1])), width, height)
    return pinhole, map_to_camera(pinhole, camera, np.eye(3))
