"""Maps in cells: splitting, and joining of cells."""

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np

from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.array_types import F64, I32, I64, Mask, NDArray, mask_of
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import IdArray, ResourceOwner, VIMap, as_keys, is_valid, ragged_rows, to_hex
from maplab_py.vimap.edits import merge_landmarks, remove_landmarks, remove_missions
from maplab_py.vimap.merge import stack
from maplab_py.vimap.selection import keep_rows
from maplab_py.vimap.sensor_merge import conflicting_sensors
from maplab_py.vimap.tables import NO_ROW
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
    is_seen = mask_of(len(vi_map.landmarks), observed)
    is_seen |= (np.diff(vi_map.observation_start) == 0) & is_inside[vi_map.landmarks.vertex]
    seen = remove_landmarks(vi_map, ~is_seen)
    kept = is_inside[(per_mission > 0)[vi_map.vertices.mission]]
    return remove_vertices(remove_missions(seen, per_mission == 0), ~kept)


# Join cells of a map that were edited apart: the inverse of the split.
#
# Entities with one id are one entity. What the cells say differently of it is decided by depth: the depth of
# a vertex in a cell is the distance to the nearest vertex that the cell lacks, and the copy in the cell where
# the vertex is deepest is taken, with its state, images, observations and absolute poses; at equal depth the
# earlier cell's. There the vertex was optimised with most of its surroundings.


class JoinReport(Report):
    """Result of joining cells."""

    cells: int
    missions: int
    vertices: int
    landmarks: int
    vertices_shared: int  # copies beside the one that was taken
    vertices_differing: int  # of these, copies with another pose in G
    largest_shift_m: float  # of such a copy
    landmarks_united: int  # different ids on one keypoint of a shared vertex
    edges_shared: int


def join_cells(cells: Sequence[VIMap], *, progress: Progress = SILENT) -> tuple[VIMap, JoinReport]:
    """Return the map that cells are parts of.

    - Missions and base frames are those of the first cell that has them; vertices keep their pose in G.
    - Vertices: see the module. What only one cell has stays, so a vertex, a landmark or an edge is removed
      from the map only if all cells that had it have removed it.
    - Landmarks with one id are stored where the earliest of the vertices is at which a cell stores them. Two
      landmarks that cells observe at the same keypoint are one: that of the copy that is taken.
    - Of edges with one id the shortest is taken: those of a cell bridge what lies in other cells.

    Args:
        cells: Maps; at equal depth earlier ones count more.

    Raises:
        MapError: The cells have no vertex, share no mission, differ in calibrations, or in the number
            of keypoints of an image.
        Cancelled: The user has asked to stop.
    """
    _check(cells)
    progress.step(0, 4, "stack cells")
    stacked = reduce(stack, cells)
    cell = np.repeat(np.arange(len(cells)), [len(c.vertices) for c in cells])
    stacked, mission = _with_common_base_frames(stacked)
    progress.step(1, 4, "unite vertices")
    taken = _deepest_copies(stacked, cell, len(cells))
    shift_m = np.linalg.norm(stacked.T_G_I[:, 4:] - stacked.T_G_I[taken, 4:], axis=1)
    is_copy = taken != np.arange(len(taken))
    edges = _num_edges(stacked)
    stacked, pairs = _unite_vertices(stacked, taken, mission)
    progress.step(2, 4, "unite landmarks")
    joined, united = _unite_landmarks(stacked, *pairs)
    progress.step(3, 4, "unite edges")
    joined = _sorted_edges(joined)
    report = JoinReport(
        cells=len(cells),
        missions=len(joined.missions),
        vertices=len(joined.vertices),
        landmarks=len(joined.landmarks),
        vertices_shared=int(is_copy.sum()),
        vertices_differing=int(np.count_nonzero(shift_m > 0.0)),
        largest_shift_m=float(shift_m.max(initial=0.0)),
        landmarks_united=united,
        edges_shared=edges - _num_edges(joined),
    )
    return joined, report


def _check(cells: Sequence[VIMap]) -> None:
    if not sum(len(cell.vertices) for cell in cells):
        raise MapError("there is no cell with vertices to join")
    for number, cell in enumerate(cells[1:], start=1):
        before = [c.sensors for c in cells[:number]]
        for sensors in before:
            if conflicts := conflicting_sensors(sensors, cell.sensors):
                raise MapError(
                    f"sensor {conflicts[0]} has another calibration in cell {number} than in an earlier "
                    "one: a map can have only one"
                )
        known = np.concatenate([c.missions.id for c in cells[:number]])
        if len(cell.missions) and not np.isin(as_keys(cell.missions.id), as_keys(known)).any():
            raise MapError(
                f"cell {number} has no mission of the cells before it: it is not a cell of the same map "
                "(merge_map adds other missions)"
            )


def _first_copies(ids: IdArray) -> I64:
    """Return the first row with the id of every row (N,); rows without id stand for themselves."""
    keys, inverse = np.unique(as_keys(ids), return_inverse=True)
    first = np.full(len(keys), len(ids))
    np.minimum.at(first, inverse, np.arange(len(ids)))
    return np.where(is_valid(ids), first[inverse], np.arange(len(ids)))


def _best_of(first: I64, *keys: NDArray[Any]) -> I64:
    """Return the best copy (N,) of rows given by their first copies: the least in the last key first."""
    order = np.lexsort((*keys, first))
    best = np.empty(len(first), dtype=np.int64)
    best[first[order[::-1]]] = order[::-1]
    return best[first]


def _with_common_base_frames(stacked: VIMap) -> tuple[VIMap, I64]:
    """Express all copies of a mission in the base frame of the first; return its row for each (M,)."""
    mission = _first_copies(stacked.missions.id)
    T_G_M = stacked.T_G_M
    differs = ~(T_G_M[mission] == T_G_M).all(axis=1)
    rows = np.flatnonzero(differs[stacked.vertices.mission])
    if not len(rows):
        return stacked, mission
    of_row = stacked.vertices.mission[rows]
    T_N_M = se3.relative(T_G_M[mission[of_row]], T_G_M[of_row])
    T_M_I = se3.compose(T_N_M, stacked.vertices.T_M_I[rows])
    v_M = so3.rotate(T_N_M[:, :4], stacked.vertices.v_M[rows])
    baseframe = stacked.missions.baseframe[mission]
    return stacked.replace(
        vertices=stacked.vertices.put(rows, T_M_I=T_M_I, v_M=v_M),
        missions=stacked.missions.replace(baseframe=baseframe),
    ), mission


def _deepest_copies(stacked: VIMap, cell: I64, cells: int) -> I64:
    """Return the row (V,) of the copy that is taken of every vertex."""
    first = _first_copies(stacked.vertices.id)
    depth_m = np.empty(len(first))
    for number in range(cells):
        inside = np.flatnonzero(cell == number)
        lacking = np.setdiff1d(first, first[inside])
        depth_m[inside] = _distances_m(stacked.T_G_I[inside, 4:], stacked.T_G_I[lacking, 4:])
    return _best_of(first, cell, -depth_m)


def _distances_m(p: F64, others: F64) -> F64:
    """Return the distance (N,) of points to the nearest other one; infinite without others."""
    from scipy.spatial import cKDTree

    if not len(others) or not len(p):
        return np.full(len(p), np.inf)
    return np.asarray(cKDTree(others).query(p)[0])


def _unite_vertices(
    stacked: VIMap, taken: I64, mission: I64
) -> tuple[VIMap, tuple[I64, I64, I64, I64]]:
    """Point references at the copies that are taken, and drop the other copies and their images.

    Returns:
        The map, still with all copies of landmarks, and rows of landmarks: those with the id of another
        one, that one; those on a keypoint of which another copy is taken, the one observed there.
    """
    is_copy = taken != np.arange(len(taken))
    twin = _twin_frames(stacked, taken)
    copies = np.flatnonzero(is_copy[stacked.frames.vertex])
    with_twin = copies[twin[copies] >= 0]
    landmark = stacked.keypoints.landmark
    theirs = landmark[ragged_rows(stacked.keypoint_start, with_twin)]
    mine = landmark[ragged_rows(stacked.keypoint_start, twin[with_twin])]
    both = (mine >= 0) & (theirs >= 0)
    from_rows, into_rows = theirs[both].astype(np.int64), mine[both].astype(np.int64)
    equal, store = _stores(stacked, taken)
    frames, vertices = stacked.frames, stacked.vertices
    resources = stacked.resources
    owner = resources.owner.astype(np.int64)
    by_frame = resources.owner_kind == ResourceOwner.FRAME
    by_mission = np.isin(resources.owner_kind, (ResourceOwner.MISSION, ResourceOwner.SENSOR))
    moved = np.where(is_copy[frames.vertex] & (twin >= 0), twin, np.arange(len(twin)))
    owner[by_frame] = moved[owner[by_frame]]
    owner[by_mission] = mission[owner[by_mission]]
    numbers = (resources.type, resources.owner_kind, owner, resources.timestamp_ns)
    keys = np.stack([np.asarray(column).astype(np.uint64) for column in numbers], axis=1)
    once = _first_rows(np.concatenate([keys, resources.id, resources.sensor_id], axis=1))
    absolute = stacked.absolute_poses
    parts = {
        name: edges.replace(from_vertex=taken[edges.from_vertex], to_vertex=taken[edges.to_vertex])
        for name, edges in (
            ("imu_edges", stacked.imu_edges),
            ("transformation_edges", stacked.transformation_edges),
            ("loop_closure_edges", stacked.loop_closure_edges),
        )
    }
    redirected = stacked.replace(
        vertices=vertices.replace(mission=mission[vertices.mission]),
        frames=frames.replace(vertex=np.where(is_copy[frames.vertex], NO_ROW, frames.vertex)),
        landmarks=stacked.landmarks.replace(vertex=store),
        absolute_poses=absolute.replace(
            vertex=np.where(is_copy[absolute.vertex], NO_ROW, absolute.vertex)
        ),
        resources=resources.replace(owner=owner).take(once),
        **parts,
    )
    kept = np.flatnonzero(~is_copy)
    table = redirected.vertices
    order = np.lexsort((table.timestamp_ns[kept], table.mission[kept]))
    missions = np.unique(mission)
    kept_map = keep_rows(redirected, missions=missions, vertices=kept[order])
    return kept_map, (np.flatnonzero(equal != np.arange(len(equal))), equal, from_rows, into_rows)


def _twin_frames(stacked: VIMap, taken: I64) -> I64:
    """Return the frame (F,) of the same camera at the copy that is taken, -1 where there is none."""
    frames = stacked.frames
    width = int(frames.camera_index.max(initial=0)) + 1
    of_slot = np.full(len(taken) * width, -1, dtype=np.int64)
    of_slot[frames.vertex.astype(np.int64) * width + frames.camera_index] = np.arange(len(frames))
    twin: I64 = of_slot[taken[frames.vertex] * width + frames.camera_index]
    has_twin = np.flatnonzero(twin >= 0)
    count = frames.keypoint_count
    differ = has_twin[count[has_twin] != count[twin[has_twin]]]
    if len(differ):
        raise MapError(
            f"frame {to_hex(frames.id[differ[0]])} has {count[differ[0]]} keypoints in one cell and "
            f"{count[twin[differ[0]]]} in another"
        )
    return twin


def _stores(stacked: VIMap, taken: I64) -> tuple[I64, I64]:
    """Return the copy (L,) of every landmark that is taken, and the vertex (L,) that stores each copy.

    It is the one stored at the earliest vertex of the mission; of those at one vertex that of the cell
    whose copy of the vertex is taken.
    """
    landmarks, vertices = stacked.landmarks, stacked.vertices
    first = _first_copies(landmarks.id)
    at = landmarks.vertex
    best = _best_of(first, np.arange(len(at)), taken[at] != at, vertices.timestamp_ns[at])
    return best, taken[at]


def _unite_landmarks(
    stacked: VIMap, copies: I64, equal: I64, from_rows: I64, into_rows: I64
) -> tuple[VIMap, int]:
    """Merge copies of landmarks, then landmarks of two ids on one keypoint; also return their number."""
    merged = merge_landmarks(stacked, copies, equal[copies])
    new_row = np.full(len(equal), -1, dtype=np.int64)
    kept = np.flatnonzero(equal == np.arange(len(equal)))
    new_row[kept] = np.arange(len(kept))
    source, target = new_row[equal[from_rows]], new_row[equal[into_rows]]
    differ = source != target
    united = merge_landmarks(merged, source[differ], target[differ])
    return united, len(merged.landmarks) - len(united.landmarks)


def _num_edges(vi_map: VIMap) -> int:
    tables = (vi_map.imu_edges, vi_map.transformation_edges, vi_map.loop_closure_edges)
    return sum(len(table) for table in tables)


def _sorted_edges(vi_map: VIMap) -> VIMap:
    """Keep the shortest edge of every id, sorted as loading sorts them."""
    imu, relative = vi_map.imu_edges, vi_map.transformation_edges
    rows = _shortest(imu.id, imu.from_vertex, imu.to_vertex)
    rows = rows[np.lexsort((imu.to_vertex[rows], imu.from_vertex[rows]))]
    chosen = _shortest(relative.id, relative.from_vertex, relative.to_vertex)
    order = (relative.to_vertex[chosen], relative.from_vertex[chosen], relative.kind[chosen])
    loops = vi_map.loop_closure_edges
    return vi_map.replace(
        imu_edges=imu.take(rows),
        imu_samples=vi_map.imu_samples.take(ragged_rows(vi_map.sample_start, rows)),
        transformation_edges=relative.take(chosen[np.lexsort(order)]),
        loop_closure_edges=loops.take(_first_rows(loops.id)),
    )


def _shortest(ids: IdArray, from_vertex: I32, to_vertex: I32) -> I64:
    """Return the rows of the edges that span fewest vertices of those with one id, in row order."""
    first = _first_copies(ids)
    span = np.abs(to_vertex.astype(np.int64) - from_vertex)
    return np.unique(_best_of(first, np.arange(len(first)), span))


def _first_rows(keys: IdArray) -> I64:
    """Return the first row of every distinct key (N, k), in row order."""
    return np.sort(np.unique(keys, axis=0, return_index=True)[1]).astype(np.int64)
