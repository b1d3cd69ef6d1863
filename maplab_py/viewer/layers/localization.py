"""A run that is localised in a map: the map, the path in it, and the latest matches as rays."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_points, make_segments, spread_rows
from maplab_py.viewer.scene import WHOLE_MAP, Layer

_MAX_LANDMARKS = 60_000
_POINT_SIZE = 0.005
"""Of the landmarks, in units of the drawing."""


@dataclasses.dataclass(frozen=True, eq=False)
class LocalizedRun:
    """Poses of a run in the map in which it is localised."""

    p_G: F64  # (L, 3) landmarks of the map
    p_G_I: F64  # (N, 3) positions, as estimated at their time
    rays_G: F64  # (K, 2, 3) from the body to the landmarks that its keypoints were matched with


def localized_layers(drawing: Drawing, run: LocalizedRun) -> list[Layer]:
    """Return the map's landmarks, the path as it was estimated online, and the matches."""
    shift = -drawing.origin_G
    kept = spread_rows(run.p_G, _MAX_LANDMARKS)
    notes = () if len(kept) == len(run.p_G) else (f"{len(kept)} of {len(run.p_G)} map landmarks",)
    points = make_points(
        run.p_G[kept] + shift, colours.REFERENCE, kept, _POINT_SIZE * drawing.unit_m
    )
    path, rays = run.p_G_I + shift, run.rays_G + shift
    steps, matches = np.arange(max(len(path) - 1, 0)), np.arange(len(rays))
    line = make_segments(path[:-1], path[1:], colours.TRUTH, steps, 3.0)
    lines = make_segments(rays[:, 0], rays[:, 1], colours.MATCHED, matches, 1.0)
    return [
        Layer("map_landmarks", "Map", {WHOLE_MAP: points}, len(run.p_G), notes=notes),
        Layer("localized_path", "Path in the map", {WHOLE_MAP: line}, len(steps)),
        Layer("map_matches", "Matches", {WHOLE_MAP: lines}, len(rays)),
    ]
