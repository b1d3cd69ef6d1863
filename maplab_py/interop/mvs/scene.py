"""Perspective images, poses and points, as the writers of this folder take them."""

from __future__ import annotations

import dataclasses

from maplab_py.array_types import F64, I64, U8


@dataclasses.dataclass(frozen=True, eq=False)
class MvsScene:
    """Images (V) of perspective cameras (C) and points (L) with observations (O)."""

    size_px: I64  # (C, 2) width and height
    K: F64  # (C, 4) fx, fy, cx, cy [px]; the centre of the first pixel is at 0, 0
    camera: I64  # (V,) rows of cameras
    names: list[str]  # (V,) files of the images
    T_C_G: F64  # (V, 7)
    p_G: F64  # (L, 3)
    colours: U8  # (L, 3) red, green, blue
    landmark: I64  # (O,) rows of points
    view: I64  # (O,) rows of images
    uv_px: F64  # (O, 2)
    error_px: F64  # (L,) mean reprojection error
