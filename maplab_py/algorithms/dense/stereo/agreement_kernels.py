"""Compiled check of a depth map against the depth maps of other views."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F32, F64, U8
from maplab_py.compilation import compiled, prange

_NEAREST_M = 0.1
"""Points nearer to the other camera are not compared [m]."""


@compiled(parallel=True)
def count_agreeing(
    depth: F32, other: F32, camera: F64, T_other_P: F64, max_difference_px: float, votes: U8
) -> None:
    """Add a vote to each pixel whose point another view sees at the same disparity.

    Args:
        depth: Depths (H, W) [m], 0 = unknown.
        other: Depths (H, W) of the other view, of the same perspective camera.
        camera: Focal length [px], centre u, centre v [px], focal length times baseline [px m].
        T_other_P: Transformation (4, 4) of points to the other view.
        max_difference_px: Largest difference of disparities that counts as the same.
        votes: Counts (H, W) to add to.
    """
    height, width = depth.shape
    focal, centre_u, centre_v, focal_baseline = camera
    for v in prange(height):
        y = (v - centre_v) / focal
        for u in range(width):
            z = np.float64(depth[v, u])
            if z <= 0.0:
                continue
            x = (u - centre_u) / focal
            p0 = (T_other_P[0, 0] * x + T_other_P[0, 1] * y + T_other_P[0, 2]) * z + T_other_P[0, 3]
            p1 = (T_other_P[1, 0] * x + T_other_P[1, 1] * y + T_other_P[1, 2]) * z + T_other_P[1, 3]
            p2 = (T_other_P[2, 0] * x + T_other_P[2, 1] * y + T_other_P[2, 2]) * z + T_other_P[2, 3]
            if p2 < _NEAREST_M:
                continue
            column = np.floor(focal * p0 / p2 + centre_u + 0.5)
            row = np.floor(focal * p1 / p2 + centre_v + 0.5)
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            seen = np.float64(other[int(row), int(column)])
            if seen > 0.0 and abs(focal_baseline / seen - focal_baseline / p2) < max_difference_px:
                votes[v, u] += 1


def compile_kernels() -> None:
    """Compile the kernel of this module."""
    depth = np.ones((2, 2), dtype=np.float32)
    votes = np.zeros((2, 2), dtype=np.uint8)
    count_agreeing(depth, depth, np.ones(4), np.eye(4), 1.0, votes)
