"""Split a map by position into cells that overlap, each a map of its own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import UserError
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import remove_landmarks, remove_missions
from maplab_py.vimap.vertex_removal import remove_vertices


def split_by_position(
    vi_map: VIMap, options: CellOptions, *, progress: Progress = SILENT
) -> list[VIMap]:
    """Return the cells of a map.

    The vertices are halved at the median of x or y in G, whichever spreads more, until there are as
    many cells as wanted; the vertices of other cells that are within the overlap of a cell's rectangle
    are in it, too. Missions that are nowhere in a cell and landmarks that no vertex of it observes are
    removed; what is left out of a mission is removed as by keyframing, so that its edges are joined.
    Ids stay, so the same vertex has one id in all cells.

    With an overlap every edge is in some cell with both its vertices, so that `join.join_cells` restores the
    map: where the overlap is shorter than an edge, the edge's second vertex is added to a cell of the first.

    Args:
        vi_map: The map.
        options: Number of cells and overlap.
        progress: Shown meanwhile.

    Raises:
        UserError: The map has fewer vertices than cells are wanted.
        Cancelled: The user has asked to stop.
    """
    p_G_I = np.asarray(vi_map.T_G_I[:, 4:6])
    if len(p_G_I) < options.count:
        raise UserError(
            f"--cell_count={options.count}: the map has only {len(p_G_I)} vertices; ask for fewer cells"
        )
    cells = []
    rectangles = _rectangles(p_G_I, options.count)
    distance_m = np.array([_distance_m(p_G_I, rectangle) for rectangle in rectangles])
    is_inside = distance_m <= options.overlap_m
    if options.overlap_m > 0.0:
        _add_second_vertices(vi_map, is_inside, np.argmin(distance_m, axis=0))
    for number, members in enumerate(is_inside):
        progress.step(number, len(rectangles), f"cell {number}")
        cells.append(_cell(vi_map, members))
    return cells


def _add_second_vertices(vi_map: VIMap, is_inside: Mask, home: I64) -> None:
    """Put the second vertex of edges that lie in no cell into the cell (V,) of the first, in place.

    Args:
        vi_map: The map.
        is_inside: Whether a vertex is in a cell (cells, V).
        home: Cell of each vertex.
    """
    for edges in (vi_map.imu_edges, vi_map.transformation_edges, vi_map.loop_closure_edges):
        first, second = edges.from_vertex, edges.to_vertex
        is_split = ~(is_inside[:, first] & is_inside[:, second]).any(axis=0)
        is_inside[home[first[is_split]], second[is_split]] = True


def _rectangles(p_G: F64, count: int) -> list[F64]:
    """Return the bounds (2, 2) [m] of cells, lower and upper, that cover the plane."""
    pieces: list[tuple[int, I64, F64]] = [
        (count, np.arange(len(p_G)), np.array([[-np.inf, -np.inf], [np.inf, np.inf]]))
    ]
    done: list[F64] = []
    while pieces:
        parts, rows, bounds = pieces.pop()
        if parts == 1:
            done.append(bounds)
            continue
        axis = int(np.argmax(np.ptp(p_G[rows], axis=0)))
        order = rows[np.argsort(p_G[rows, axis], kind="stable")]
        lower_parts = parts // 2
        cut = len(order) * lower_parts // parts
        value = 0.5 * (p_G[order[cut - 1], axis] + p_G[order[cut], axis])
        lower, upper = bounds.copy(), bounds.copy()
        lower[1, axis] = upper[0, axis] = value
        pieces.append((parts - lower_parts, order[cut:], upper))
        pieces.append((lower_parts, order[:cut], lower))
    return done


def _distance_m(p_G: F64, bounds: F64) -> NDArray[np.float64]:
    """Return the horizontal distance (N,) [m] of points to a rectangle; 0 inside."""
    beyond = np.maximum(np.maximum(bounds[0] - p_G, p_G - bounds[1]), 0.0)
    return np.asarray(np.hypot(beyond[:, 0], beyond[:, 1]))


def _cell(vi_map: VIMap, is_inside: Mask) -> VIMap:
    per_mission = np.bincount(vi_map.vertices.mission[is_inside], minlength=len(vi_map.missions))
    keypoints = vi_map.observations
    observed = vi_map.keypoints.landmark[keypoints[is_inside[vi_map.keypoint_vertex[keypoints]]]]
    is_seen = np.zeros(len(vi_map.landmarks), dtype=np.bool_)
    is_seen[observed] = True
    is_seen |= (np.diff(vi_map.observation_start) == 0) & is_inside[vi_map.landmarks.vertex]
    seen = remove_landmarks(vi_map, ~is_seen)
    kept = is_inside[(per_mission > 0)[vi_map.vertices.mission]]
    return remove_vertices(remove_missions(seen, per_mission == 0), ~kept)
