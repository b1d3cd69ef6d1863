"""Spread missions with unknown base frame in space for visualisation."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class LayoutOptions:
    """Layout of missions with unknown base frame; maplab's names and defaults."""

    flag_prefix: ClassVar[str] = "spatially_distribute_missions_"

    meters: float = option(20.0, help="Distance of neighbours, or radius of the circle.", unit="m")
    dimension: int = option(0, help="Axis to shift along: 0 = x, 1 = y, 2 = z.")
    around_circle: bool = option(False, help="Spread the missions around a circle instead.")

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.dimension not in (0, 1, 2):
            raise FlagError("--spatially_distribute_missions_dimension must be 0, 1 or 2")


def distribute_missions(vi_map: VIMap, options: LayoutOptions) -> tuple[VIMap, int]:
    """Shift the base frames of missions whose base frame is unknown; return how many there are.

    The i-th mission moves to i times the distance along the axis, or to the i-th place on the circle;
    the orientation of its base frame does not change.
    """
    frames = vi_map.baseframes
    rows = vi_map.missions.baseframe[~frames.is_known[vi_map.missions.baseframe]]
    if len(rows) == 0:
        return vi_map, 0
    T_G_M = frames.T_G_M.copy()
    number = np.arange(len(rows))
    place = np.zeros((len(rows), 3))
    if options.around_circle:
        angle = 2.0 * np.pi * number / len(rows)
        place[:, 0] = options.meters * np.cos(angle)
        place[:, 1] = options.meters * np.sin(angle)
    else:
        place[:, options.dimension] = options.meters * (number + 1)
    T_G_M[rows, 4:] = place
    return vi_map.replace(baseframes=frames.replace(T_G_M=T_G_M)), len(rows)
