"""Occlusion of lines of sight by axis-parallel boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64


def is_hidden(boxes: F64, eye: F64, point: F64) -> NDArray[np.bool_]:
    """Return which lines of sight from eyes (N, 3) to points (N, 3) cross a box of (B, 2, 3).

    The slab test of Kay and Kajiya (1986), one box at a time.
    """
    hidden = np.zeros(len(eye), dtype=np.bool_)
    direction = point - eye
    direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    inverse = 1.0 / direction
    for low, high in boxes:
        a, b = (low - eye) * inverse, (high - eye) * inverse
        enters = np.minimum(a, b).max(axis=1)
        leaves = np.maximum(a, b).min(axis=1)
        hidden |= (enters < leaves) & (leaves > 0.0) & (enters < 1.0 - 1e-9)
    return hidden
