"""Stretches of trajectories: what counts as one observation of a place.

Neighbouring images see the same landmarks, so their closures are no independent evidence, and a
device at rest would outvote everything else. Evidence is therefore counted in stretches, within
which the body moves by about a metre or turns by about a radian.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import I64
from maplab_py.geometry import so3
from maplab_py.vimap import VIMap

_LENGTH = 1.0
"""Length of a stretch: metres travelled plus radians turned."""


def trajectory_stretches(vi_map: VIMap) -> I64:
    """Return the number of the stretch (V,) of each vertex, increasing over the whole map."""
    T, mission = vi_map.vertices.T_M_I, vi_map.vertices.mission
    if len(T) == 0:
        return np.zeros(0, dtype=np.int64)
    turn = so3.log(so3.multiply(so3.inverse(T[:-1, :4]), T[1:, :4]))
    motion = np.linalg.norm(np.diff(T[:, 4:], axis=0), axis=1) + np.linalg.norm(turn, axis=1)
    starts = mission[1:] != mission[:-1]
    motion[starts] = 0.0
    travelled = np.append(0.0, np.cumsum(motion))
    first = vi_map.vertex_start[:-1][mission]
    within = np.floor((travelled - travelled[first]) / _LENGTH).astype(np.int64)
    begins = np.append(True, (np.diff(within) > 0) | starts)
    return np.asarray(np.cumsum(begins) - 1)
