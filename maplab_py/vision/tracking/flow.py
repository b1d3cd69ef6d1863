"""Pyramidal Lucas-Kanade from a prediction, forwards and back again; see `flow_kernels`."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, U8, Mask
from maplab_py.vision.tracking import flow_kernels

_BORDER_PX = 16
"""Border of the levels beyond two sides of a patch, so that those at the edge of an image can be compared."""

_LEVELS_OF_NEAR = 1
"""Level on which the search for keypoints begins that are expected within a few pixels."""

_CONFIRMED_PX = 1.0
"""Keypoints that arrive so near to where they were expected need not be tracked back."""


@dataclasses.dataclass(frozen=True)
class FlowOptions:
    """Parameters of Lucas-Kanade."""

    patch_size_px: int
    levels: int  # above the image
    forward_backward_px: float


@dataclasses.dataclass(frozen=True, eq=False)
class Pyramid:
    """An image, and it and its levels of half resolution with borders."""

    image: U8  # (H, W)
    border_px: int
    levels: tuple[U8, ...]  # the image first

    @classmethod
    def of(cls, image: U8, options: FlowOptions) -> Pyramid:
        """Make the levels that patches fit into."""
        import cv2

        border, level = 2 * options.patch_size_px + _BORDER_PX, image
        levels: list[U8] = []
        for _ in range(options.levels + 1):
            if levels:
                level = np.asarray(cv2.pyrDown(level), dtype=np.uint8)
            if levels and min(level.shape) <= options.patch_size_px:
                break
            bordered = cv2.copyMakeBorder(
                level, border, border, border, border, cv2.BORDER_REFLECT_101
            )
            levels.append(np.asarray(bordered, dtype=np.uint8))
        return cls(image, border, tuple(levels))


def follow(
    first: U8 | Pyramid,
    second: U8 | Pyramid,
    uv: F64,
    predicted_uv: F64,
    options: FlowOptions,
    is_near: Mask | None = None,
) -> tuple[F64, Mask]:
    """Find keypoints of an image again in another one.

    Args:
        first: Image (H, W) of the keypoints.
        second: Image in which they are sought.
        uv: Keypoints (K, 2).
        predicted_uv: Where they are expected (K, 2).
        is_near: Keypoints (K,) that are expected within a few pixels: lower levels will do for them.

    Returns:
        Keypoints (K, 2) in the second image, and whether they were found (K,): inside the image,
        and tracked back to where they came from.
    """
    first, second = (
        image if isinstance(image, Pyramid) else Pyramid.of(image, options)
        for image in (first, second)
    )
    there, is_tracked = search(first, second, uv, predicted_uv, options, is_near=is_near)
    doubtful = is_tracked.copy()
    if is_near is not None:
        off_px = np.abs(there - predicted_uv).max(axis=1, initial=0.0)
        doubtful &= ~is_near | (off_px > _CONFIRMED_PX)
    rows = np.flatnonzero(doubtful)
    is_tracked[rows] = is_tracked_back(first, second, uv[rows], there[rows], options)
    return there, is_tracked


def search(
    first: Pyramid,
    second: Pyramid,
    uv: F64,
    predicted_uv: F64,
    options: FlowOptions,
    turn: F64 | None = None,
    is_near: Mask | None = None,
) -> tuple[F64, Mask]:
    """Find keypoints as `follow` does, without the way back, with a turn (2, 2) of the image."""
    coarsest = min(len(first.levels), len(second.levels)) - 1  # cameras of a rig may differ in size
    levels = np.full(len(uv), coarsest)
    if is_near is not None:
        levels[is_near] = min(_LEVELS_OF_NEAR, coarsest)
    there, is_tracked = _flow(first, second, uv, predicted_uv, options, levels, turn)
    height, width = second.image.shape
    inside = np.all((there >= 0.0) & (there <= np.array([width - 1, height - 1])), axis=1)
    return there, is_tracked & inside


def is_tracked_back(
    first: Pyramid,
    second: Pyramid,
    uv: F64,
    there: F64,
    options: FlowOptions,
    turn: F64 | None = None,
) -> Mask:
    """Tell which keypoints (K, 2) are tracked from the second image back to where they came from."""
    # the way back starts at its end: it needs no pyramid
    back_turn = None if turn is None else np.ascontiguousarray(turn.T)
    back, is_back = _flow(
        second, first, there, uv, options, np.zeros(len(uv), dtype=np.int64), back_turn
    )
    error = np.linalg.norm(back - uv, axis=1)
    return np.asarray(is_back & (error <= options.forward_backward_px))


def in_plane_turn(R_C1_C0: F64) -> F64:
    """Return the turn (2, 2) of an image about the optical axis between two cameras."""
    sin, cos = R_C1_C0[1, 0] - R_C1_C0[0, 1], R_C1_C0[0, 0] + R_C1_C0[1, 1]
    length = np.hypot(sin, cos)
    return np.array([[cos, -sin], [sin, cos]]) / length if length > 0.0 else np.eye(2)


def _flow(
    first: Pyramid,
    second: Pyramid,
    uv: F64,
    guess_uv: F64,
    options: FlowOptions,
    levels: I64,
    turn: F64 | None,
) -> tuple[F64, Mask]:
    there = np.array(guess_uv, dtype=np.float64, order="C")
    is_tracked: Mask = np.zeros(len(uv), dtype=np.bool_)
    turn = np.eye(2) if turn is None else turn
    for level in range(int(levels.max(initial=0)), -1, -1):
        flow_kernels.follow_on_level(
            first.levels[level], second.levels[level], first.border_px, options.patch_size_px,
            level, turn, uv, there, levels, is_tracked,
        )  # fmt: skip
    return np.where(is_tracked[:, None], there, uv), is_tracked
