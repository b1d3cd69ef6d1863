"""Ray casting of images and depth of a scene through the true camera model."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Self

import numpy as np

from maplab_py.array_types import F32, F64, Mask
from maplab_py.compilation import compiled
from maplab_py.geometry import so3
from maplab_py.simulation.scene import Scene
from maplab_py.simulation.shading_kernels import (
    DISTANCE,
    DX,
    DY,
    DZ,
    FAST,
    HALF,
    IX,
    IY,
    IZ,
    SURFACE,
    TILE,
    UNITY,
    ZERO,
    PaintedBoxes,
    X,
    pack_texels,
    shade,
)


def painted_boxes(scene: Scene) -> PaintedBoxes:
    """Return a scene as the ray caster reads it; its texels take four times the memory."""
    textures = scene.textures
    layout = np.stack([textures.offset, textures.width, textures.height], axis=2).astype(np.int32)
    texels = np.empty(len(textures.pixels), dtype=np.int32)
    pack_texels(textures.pixels, layout, texels)
    return PaintedBoxes(
        scene.boxes.astype(np.float32),
        scene.surfaces.corner.astype(np.float32),
        texels,
        layout,
        np.float32(textures.texel_m),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class RayCaster:
    """A camera model in a scene."""

    painted: PaintedBoxes
    rays: PixelRays

    @classmethod
    def of(cls, painted: PaintedBoxes, rays: F64, focal_px: float) -> Self:
        """Prepare the rays of a camera.

        Args:
            painted: The scene, see `painted_boxes`.
            rays: Points (H, W, 2) on the plane z = 1, NaN = black.
            focal_px: Focal length, which determines the footprint of a pixel.
        """
        seen = np.isfinite(rays[..., 0])
        x, y = (np.where(seen, rays[..., axis], 0.0).astype(np.float32) for axis in (0, 1))
        directions = np.stack([x, y, np.ones_like(x)], axis=2)
        row_cones = _cones(directions, seen, max(1, x.shape[1]))[:, 0]
        cones = _cones(directions, seen, TILE)
        is_seen = seen.astype(np.float32)
        return cls(painted, PixelRays(x, y, is_seen, row_cones, cones, np.float32(focal_px)))

    def render(self, T_G_C: F64) -> tuple[F32, F32]:
        """Return grey values (H, W) in 0 .. 255 and depths along z (H, W) [m]; 0 without a ray.

        Args:
            T_G_C: Pose (1, 7) of the camera, or (H, 7) at each row.
        """
        grey, depth = np.zeros_like(self.rays.seen), np.zeros_like(self.rays.seen)
        self.add(T_G_C, 1.0, grey, depth)
        return grey, depth

    def add(self, T_G_C: F64, weight: float, grey: F32, depth: F32) -> None:
        """Add weighted grey values to `grey` (H, W), and overwrite `depth` (H, W)."""
        R_G_C = so3.to_matrix(T_G_C[:, :4]).astype(np.float32)
        p_G_C = T_G_C[:, 4:].astype(np.float32)
        cast_rays(self.painted, self.rays, R_G_C, p_G_C, np.float32(weight), grey, depth)


def _cones(rays: F32, seen: Mask, tile: int) -> F32:
    """Return cones (H, tiles, 5) about rays (H, W, 3): axis, cosine and sine of the half angle.

    Args:
        rays: Rays of any length.
        seen: Which of them (H, W) exist; a tile without any gets a cone without an axis.
        tile: Rays of a row that share a cone.
    """
    height, width = seen.shape
    # in double precision: the sine of a narrow cone is lost in single precision
    direction = rays.astype(np.float64)
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    cones = np.empty((height, -(-width // tile), 5), dtype=np.float32)
    for number, first in enumerate(range(0, width, tile)):
        part, there = direction[:, first : first + tile], seen[:, first : first + tile]
        axis = np.sum(part * there[..., None], axis=1)
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-6)
        cosine = np.where(there, np.einsum("hwi,hi->hw", part, axis), 1.0).min(axis=1)
        cones[:, number, :3], cones[:, number, 3] = axis, cosine
        cones[:, number, 4] = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return cones


# Compiled ray caster: where the rays of an image meet boxes, and what grey value is painted there.
#
# A row of an image is cast in tiles; each step is a loop over the pixels of a tile, see
# `shading_kernels`. A tile tests its rays only against boxes that its cone of rays can meet, and only
# those boxes are candidates for a tile that the cone of the whole row can meet. The cones are slightly
# too wide, so that no rounding excludes a box that a ray meets: the image is that of all boxes.
#
# Source: the slab test is that of Kay and Kajiya (1986).

_TINY = np.float32(1e-9)
_ROUNDING = np.float32(1e-5)
_WIDENED = np.float32(1.001)
"""Factor on the radii of spheres round boxes; covers the rounding of a camera that nearly touches one."""


class PixelRays(NamedTuple):
    """Rays of the pixels of a camera."""

    x: F32  # (H, W) on the plane z = 1
    y: F32  # (H, W)
    seen: F32  # (H, W) 1 where there is a ray, else 0
    row_cones: F32  # (H, 5) about the rays of a row: axis, cosine and sine of the half angle
    cones: F32  # (H, tiles, 5) about those of a tile
    focal_px: np.float32


@compiled(**FAST)
def cast_rays(scene, rays, R_G_C, p_G_C, weight, grey, depth):  # type: ignore[no-untyped-def]
    """Add the weighted grey values of an image to `grey`, and fill in the depths.

    Args:
        scene: The `PaintedBoxes`.
        rays: The `PixelRays`.
        R_G_C: Rotation of the camera (1, 3, 3), or (H, 3, 3) one per row.
        p_G_C: Position of the camera (1, 3) or (H, 3).
        weight: Share of this image in a sum of several.
        grey: Grey values (H, W), 0 to 255.
        depth: Depths along z (H, W) [m]; 0 where there is no ray.
    """
    height, width = rays.x.shape
    real, whole = np.empty(14 * TILE, np.float32), np.empty(5 * TILE, np.int32)
    spheres = np.empty((len(scene.boxes), 5), np.float32)
    every = np.arange(1, len(scene.boxes))
    in_row, in_tile = np.empty_like(every), np.empty_like(every)
    for row in range(height):
        pose = row if len(R_G_C) > 1 else 0
        R, eye = R_G_C[pose], p_G_C[pose]
        if pose == row:
            _aim(scene.boxes, R, eye, spheres)
        boxes_in_row = _select(rays.row_cones[row], spheres, every, len(every), in_row)
        for first in range(0, width, TILE):
            count = min(TILE, width - first)
            cone = rays.cones[row, first // TILE]
            boxes_in_tile = _select(cone, spheres, in_row, boxes_in_row, in_tile)
            _turn(rays.x[row, first : first + count], rays.y[row, first : first + count], R, real)
            _leave_space(scene.boxes[0], eye, count, real, whole)
            for box in in_tile[:boxes_in_tile]:
                _enter_box(scene.boxes[box], np.int32(6 * box), eye, count, real, whole)
            shade(scene, rays.focal_px, eye, count, real, whole)
            for j in range(count):
                there = rays.seen[row, first + j]
                grey[row, first + j] += weight * there * real[X + j]
                depth[row, first + j] = there * real[DISTANCE + j]


@compiled(**FAST)
def _aim(boxes, R, eye, spheres):  # type: ignore[no-untyped-def]
    """Fill in the cones (B, 5) in C about the spheres round boxes: axis, cosine and sine of half angles.

    A sphere that the camera is in gets no axis and the half angle pi.
    """
    for box in range(1, len(boxes)):
        gx = HALF * (boxes[box, 0, 0] + boxes[box, 1, 0]) - eye[0]
        gy = HALF * (boxes[box, 0, 1] + boxes[box, 1, 1]) - eye[1]
        gz = HALF * (boxes[box, 0, 2] + boxes[box, 1, 2]) - eye[2]
        side_x, side_y, side_z = boxes[box, 1] - boxes[box, 0]
        radius = _WIDENED * HALF * np.sqrt(side_x * side_x + side_y * side_y + side_z * side_z)
        distance = np.sqrt(gx * gx + gy * gy + gz * gz)
        if distance <= radius:
            spheres[box, :3], spheres[box, 3], spheres[box, 4] = ZERO, -UNITY, ZERO
            continue
        for axis in range(3):
            along = R[0, axis] * gx + R[1, axis] * gy + R[2, axis] * gz
            spheres[box, axis] = along / distance
        sine = radius / distance
        spheres[box, 3], spheres[box, 4] = np.sqrt(UNITY - sine * sine), sine


@compiled(**FAST)
def _select(cone, spheres, candidates, count, selected):  # type: ignore[no-untyped-def]
    """Fill in which of the first `count` candidates a cone of rays can meet, in their order.

    A cone and a sphere, both as cones with equal apex, are apart if the angle between their axes is
    larger than the sum of their half angles, and that sum is below pi (its sine is positive).

    Returns:
        The number of the selected boxes.
    """
    axis_x, axis_y, axis_z, cosine, sine = cone[0], cone[1], cone[2], cone[3], cone[4]
    number = 0
    for i in range(count):
        box = candidates[i]
        sphere_cosine, sphere_sine = spheres[box, 3], spheres[box, 4]
        between = axis_x * spheres[box, 0] + axis_y * spheres[box, 1] + axis_z * spheres[box, 2]
        sum_cosine = cosine * sphere_cosine - sine * sphere_sine
        sum_sine = sine * sphere_cosine + cosine * sphere_sine
        is_apart = (between < sum_cosine - _ROUNDING) & (sum_sine > ZERO)
        selected[number] = box
        number += not is_apart
    return number


@compiled(**FAST)
def _turn(x, y, R, real):  # type: ignore[no-untyped-def]
    """Fill in the directions in G of rays through (x, y, 1), and the inverses of their coordinates."""
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = (
        R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]
    )  # fmt: skip
    for j in range(len(x)):
        dx = r00 * x[j] + r01 * y[j] + r02
        dy = r10 * x[j] + r11 * y[j] + r12
        dz = r20 * x[j] + r21 * y[j] + r22
        real[DX + j], real[DY + j], real[DZ + j] = dx, dy, dz
        real[IX + j] = UNITY / (_TINY if abs(dx) < _TINY else dx)
        real[IY + j] = UNITY / (_TINY if abs(dy) < _TINY else dy)
        real[IZ + j] = UNITY / (_TINY if abs(dz) < _TINY else dz)


@compiled(**FAST)
def _leave_space(box, eye, count, real, whole):  # type: ignore[no-untyped-def]
    """Fill in the distance at which rays leave the space, and through which of its sides."""
    low_x, low_y, low_z = box[0, 0] - eye[0], box[0, 1] - eye[1], box[0, 2] - eye[2]
    high_x, high_y, high_z = box[1, 0] - eye[0], box[1, 1] - eye[1], box[1, 2] - eye[2]
    for j in range(count):
        right, left, up = real[DX + j] > ZERO, real[DY + j] > ZERO, real[DZ + j] > ZERO
        nearest = (high_x if right else low_x) * real[IX + j]
        other_y = (high_y if left else low_y) * real[IY + j]
        other_z = (high_z if up else low_z) * real[IZ + j]
        side = np.int32(1) if right else np.int32(0)
        side_y = np.int32(3) if left else np.int32(2)
        side_z = np.int32(5) if up else np.int32(4)
        side = side_y if other_y < nearest else side
        nearest = other_y if other_y < nearest else nearest
        whole[SURFACE + j] = side_z if other_z < nearest else side
        real[DISTANCE + j] = other_z if other_z < nearest else nearest


@compiled(**FAST)
def _enter_box(box, surface, eye, count, real, whole):  # type: ignore[no-untyped-def]
    """Shorten rays that meet a box, whose first side is number `surface`."""
    low_x, low_y, low_z = box[0, 0] - eye[0], box[0, 1] - eye[1], box[0, 2] - eye[2]
    high_x, high_y, high_z = box[1, 0] - eye[0], box[1, 1] - eye[1], box[1, 2] - eye[2]
    for j in range(count):
        enter, leave = _slab(low_x * real[IX + j], high_x * real[IX + j])
        enter_y, leave_y = _slab(low_y * real[IY + j], high_y * real[IY + j])
        enter_z, leave_z = _slab(low_z * real[IZ + j], high_z * real[IZ + j])
        leave = leave_y if leave_y < leave else leave
        leave = leave_z if leave_z < leave else leave
        side = np.int32(0) if real[DX + j] > ZERO else np.int32(1)
        side_y = np.int32(2) if real[DY + j] > ZERO else np.int32(3)
        side_z = np.int32(4) if real[DZ + j] > ZERO else np.int32(5)
        side = side_y if enter_y > enter else side
        enter = enter_y if enter_y > enter else enter
        side = side_z if enter_z > enter else side
        enter = enter_z if enter_z > enter else enter
        best, before = real[DISTANCE + j], whole[SURFACE + j]
        hit = (enter < leave) & (enter > ZERO) & (enter < best)
        real[DISTANCE + j] = enter if hit else best
        whole[SURFACE + j] = np.int32(surface + side) if hit else before


@compiled(forceinline=True, **FAST)
def _slab(a, b):  # type: ignore[no-untyped-def]
    """Return the smaller and the larger of two distances."""
    return (a if a < b else b), (b if a < b else a)
