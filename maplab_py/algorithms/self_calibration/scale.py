"""Whether the data know how long a metre is.

A device that only turns on the spot says nothing of lengths. Its landmarks and the lever arm of its
camera can then shrink together while solving: accelerations vanish with them, nothing contradicts,
and once everything is small all lengths look certain. The linearised problem at the solution cannot
tell; that the path has become so much shorter does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import EstimationError
from maplab_py.estimation.states import States

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_LOST = 0.5
"""Calibrating changes the length of a path by a few per cent; turning on the spot lost 93 to 98 %."""


def path_length_m(T_G_I: F64, mission: NDArray[np.integer]) -> float:
    """Return the length of the paths through poses (V, 7) of missions (V,), summed up [m]."""
    step = np.linalg.norm(np.diff(T_G_I[:, 4:], axis=0), axis=1)
    return float(step[mission[1:] == mission[:-1]].sum())


def check_scale(before: States, after: States, mission: NDArray[np.integer]) -> None:
    """Refuse a solution whose path has lost its length.

    Args:
        before: States that the solution began from.
        after: The solution.
        mission: Mission (V,) of each vertex.

    Raises:
        EstimationError: More than half of the path's length is gone, or it has doubled.
    """
    known, found = (path_length_m(states.T_G_I, mission) for states in (before, after))
    if found < _LOST * known or found * _LOST > known:
        raise EstimationError(
            "the data do not determine the calibration (camera position and all other lengths: not "
            f"excited; solving took the path from {known:.2f} m to {found:.2f} m): record motion that "
            "also moves the device to and fro, with accelerations along all axes"
        )
