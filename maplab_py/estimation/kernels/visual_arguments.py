"""Arguments of the generated visual kernels; each group is one argument.

O observations of L landmarks by V vertices and C cameras; W columns of a camera, 0 where cameras are
not estimated. Sums are kept apart by chunks of landmarks (see `terms.visual_structure`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I32, I64


class VisualData(NamedTuple):
    """Measurements."""

    start: I64  # (L + 1,) offsets by landmark
    vertex: I32  # (O,)
    camera: I32  # (O,)
    uv_px: F64  # (O, 2)
    inverse_sigma: F64  # (O,) [1/px]; 0 = does not take part
    scale2: F64  # (O,) squared scale of the loss
    uv_motion: F64  # (O, 2) [px/s], read where W > 0; with line delays (O, 3), the row v beside it


class VisualStates(NamedTuple):
    """States at which residuals are evaluated."""

    T_G_I: F64  # (V, 7)
    T_I_C: F64  # (C, 7)
    parameters: F64  # (C, 1 + widest)
    p_G: F64  # (L, 3)
    timing_s: F64  # (C, 1) image delay, or (C, 2) with the time between two rows as well


class VisualRule(NamedTuple):
    """Weights of residuals, and elimination of landmarks."""

    loss: int
    damping: float
    moves_points: bool


class VisualTarget(NamedTuple):
    """Storage in which the blocks of the poses are summed; see `linear.block_storage`."""

    nodes_per_vertex: int
    places: I32  # (4 B,) of the parts of the plan's blocks, see `terms.visual.node_blocks`
    position: I64  # (nodes,)
    column_start: I64  # (nodes,)
    leading: I64  # (nodes,)


class VisualSums(NamedTuple):
    """Normal equations by chunk, before the landmarks' share is subtracted from the blocks."""

    square: F64  # (chunks, V, 6, 6); its diagonal is that of the unreduced equations
    gradient: F64  # (chunks, V, 6)
    border: F64  # (chunks, C, V, W, 6)
    camera_square: F64  # (chunks, C, C, W, W)
    camera_gradient: F64  # (chunks, C, W)
    camera_diagonal: F64  # (chunks, C, W)

    @classmethod
    def zeros(cls, chunks: int, vertices: int, cameras: int, width: int) -> VisualSums:
        """Return sums of nothing."""
        return cls(
            np.zeros((chunks, vertices, 6, 6)),
            np.zeros((chunks, vertices, 6)),
            np.zeros((chunks, cameras, vertices, width, 6)),
            np.zeros((chunks, cameras, cameras, width, width)),
            np.zeros((chunks, cameras, width)),
            np.zeros((chunks, cameras, width)),
        )
