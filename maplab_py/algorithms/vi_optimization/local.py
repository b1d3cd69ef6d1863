"""Local optimisation of new vertices and their neighbours; all other vertices are fixed.

Free are the new vertices and those that share most landmarks with them; fixed are other
vertices that observe a landmark of a free vertex. Landmarks of free vertices are free. The numbers of
free and fixed vertices, and hence the time, are bounded for maps of any size. The result is the optimum
of all states given the fixed vertices, whose errors are left to the next joint optimisation.
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.algorithms.vi_optimization.reports import VIOptimizationReport
from maplab_py.array_types import I64, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, excerpts

_MIN_SHARED = 5
"""Vertices that share fewer landmarks with the free ones are left out."""


@dataclasses.dataclass(frozen=True)
class LocalReport:
    """Size and result of a local optimisation."""

    free_vertices: int
    fixed_vertices: int
    optimization: VIOptimizationReport


def optimize_around(
    vi_map: VIMap,
    vertices: I64,
    options: VIOptimizationOptions,
    *,
    max_free: int,
    max_fixed: int,
    progress: Progress = SILENT,
) -> tuple[VIMap, LocalReport]:
    """Optimise vertices (rows) and their neighbours.

    Args:
        vertices: New vertices; always free, unless they are a whole cluster without a fixed vertex.
        max_free: Largest number of further free vertices.
        max_fixed: Largest number of fixed vertices, besides the neighbours along trajectories.

    Raises:
        EstimationError: Nothing can be optimised.
    """
    is_new = mask_of(len(vi_map.vertices), vertices)
    is_known = vi_map.baseframes.is_known[vi_map.missions.baseframe][vi_map.vertices.mission]
    missions = distinct(vi_map.vertices.mission[vertices])
    usable = is_known | np.isin(vi_map.vertices.mission, missions)
    is_free = is_new | _most_shared(vi_map, is_new, usable & ~is_new, max_free)
    is_fixed = _most_shared(vi_map, is_free, usable & ~is_free, max_fixed)
    is_fixed |= _neighbours(vi_map, is_free)
    part = excerpts.excerpt(vi_map, is_free | is_fixed, observed_by=is_free)
    rows = np.flatnonzero(is_fixed[part.vertices])
    result, report = optimize(part.vi_map, options, fixed_vertices=rows, progress=progress)
    sizes = int(np.count_nonzero(is_free)), len(rows)
    whole = part.written_back(result, vertices=is_free[part.vertices])
    return whole, LocalReport(*sizes, report)


def _most_shared(vi_map: VIMap, seeds: Mask, wanted: Mask, count: int) -> Mask:
    """Return up to `count` wanted vertices (V,) that share most landmarks with the seeds."""
    keypoints = vi_map.observations
    landmark, vertex = vi_map.keypoints.landmark[keypoints], vi_map.keypoint_vertex[keypoints]
    is_seen = mask_of(len(vi_map.landmarks), landmark[seeds[vertex]])
    shared = np.bincount(vertex[is_seen[landmark]], minlength=len(vi_map.vertices))
    shared[~wanted | (shared < _MIN_SHARED)] = 0
    order = np.argsort(-shared, kind="stable")[:count]
    return mask_of(len(vi_map.vertices), order[shared[order] > 0])


def _neighbours(vi_map: VIMap, is_free: Mask) -> Mask:
    """Return the vertices (V,) next to free ones along trajectories that are not free themselves."""
    same = vi_map.vertices.mission[1:] == vi_map.vertices.mission[:-1]
    result = np.zeros_like(is_free)
    result[1:] |= is_free[:-1] & same
    result[:-1] |= is_free[1:] & same
    return np.asarray(result & ~is_free)
