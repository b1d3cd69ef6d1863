"""Uncertainties and switch variables of edges."""

from enum import Enum

import numpy as np

from maplab_py.algorithms.loop_closure.closure_table import closure_ids
from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.array_types import F64
from maplab_py.errors import FlagError, UserError
from maplab_py.geometry import se3
from maplab_py.vimap import IdIndex, LoopClosureEdges, TransformationKind, VIMap, to_hex


class EdgeType(Enum):
    """Edges that carry a covariance."""

    LOOP_CLOSURE = "loop_closure"
    ODOMETRY = "odometry"
    WHEEL_ODOMETRY = "wheel_odometry"
    TRANSFORMATION = "transformation"


_KINDS = {
    EdgeType.ODOMETRY: TransformationKind.ODOMETRY,
    EdgeType.WHEEL_ODOMETRY: TransformationKind.WHEEL_ODOMETRY,
    EdgeType.TRANSFORMATION: TransformationKind.TRANSFORMATION,
}


def assign_covariance(
    vi_map: VIMap, edge_type: EdgeType, *, position_sigma_m: float, orientation_sigma_deg: float
) -> tuple[VIMap, int]:
    """Give all edges of a type the same diagonal covariance; also return how many there are.

    Raises:
        FlagError: A standard deviation is not positive.
        UserError: The map has no such edge.
    """
    if position_sigma_m <= 0.0:
        raise FlagError("--translation_std_dev_meters must be given and positive")
    if orientation_sigma_deg <= 0.0:
        raise FlagError("--orientation_std_dev_degrees must be given and positive")
    sigma = np.repeat([position_sigma_m, np.deg2rad(orientation_sigma_deg)], 3)
    if edge_type is EdgeType.LOOP_CLOSURE:
        closures = _loop_closures(vi_map)
        covariance = np.broadcast_to(np.diag(sigma**2), (len(closures), 6, 6))
        result = vi_map.replace(loop_closure_edges=closures.replace(covariance=covariance))
        return result, len(closures)
    edges = vi_map.transformation_edges
    mine = edges.kind == _KINDS[edge_type]
    if not mine.any():
        raise UserError(f"the map has no edge of type {edge_type.value}")
    edges = edges.put(mine, covariance=np.diag(sigma**2))
    result = vi_map.replace(transformation_edges=edges)
    return result, int(mine.sum())


def assign_switch_variables(
    vi_map: VIMap, *, value: float | None = None, variance: float | None = None
) -> tuple[VIMap, int]:
    """Give all loop closure edges a switch variable or its prior's variance; return how many.

    Raises:
        FlagError: The value is outside [0, 1], or the variance is not positive.
        UserError: The map has no loop closure edge.
    """
    if value is not None and not 0.0 <= value <= 1.0:
        raise FlagError(f"--lc_switch_variable_value={value:g}: must be between 0 and 1")
    if variance is not None and not variance > 0.0:
        raise FlagError(f"--lc_switch_variable_variance={variance:g}: must be positive")
    edges = _loop_closures(vi_map)
    columns: dict[str, F64] = {}
    if value is not None:
        columns["switch_variable"] = np.full(len(edges), value)
    if variance is not None:
        columns["switch_variable_variance"] = np.full(len(edges), variance)
    return vi_map.replace(loop_closure_edges=edges.replace(**columns)), len(edges)


def _loop_closures(vi_map: VIMap) -> LoopClosureEdges:
    if len(vi_map.loop_closure_edges) == 0:
        raise UserError(
            "the map has no loop closure edge: see lc --lc_insert_lc_edge_instead_of_merging",
            remedy="lc --lc_insert_lc_edge_instead_of_merging",
        )
    return vi_map.loop_closure_edges


_SIGMA_M, _SIGMA_RAD = 0.01, 0.01
_SWITCH_VARIANCE = 1e-8


def tie_stationary(vi_map: VIMap, options: StationaryOptions) -> tuple[VIMap, tuple[str, ...]]:
    """Add a loop closure edge from the first to the last vertex of each mission that stands still.

    The edge says that both have the same pose (0.01 m, 0.01 rad). A mission that has the edge gets no
    second one.

    Returns:
        The map, and the ids of the missions that stand still.
    """
    first, last, missions = [], [], []
    for mission in range(len(vi_map.missions)):
        start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
        if stop - start < 2:
            continue
        T_A_B = se3.relative(vi_map.vertices.T_M_I[start], vi_map.vertices.T_M_I[start + 1 : stop])
        moved_m = np.linalg.norm(T_A_B[:, 4:], axis=1).max()
        turned_rad = 2.0 * np.arccos(np.minimum(np.abs(T_A_B[:, 3]), 1.0)).max()
        if moved_m <= options.max_translation_m and turned_rad <= options.max_rotation_rad:
            first.append(start)
            last.append(stop - 1)
            missions.append(to_hex(vi_map.missions.id[mission]))
    if not missions:
        return vi_map, ()
    ends = np.array(first), np.array(last)
    ids = closure_ids(vi_map, *ends)
    sigma = np.repeat([_SIGMA_M, _SIGMA_RAD], 3)
    edges = LoopClosureEdges.filled(
        len(missions),
        id=ids,
        from_vertex=ends[0],
        to_vertex=ends[1],
        T_A_B=np.tile(se3.identity(), (len(missions), 1)),
        covariance=np.tile(np.diag(sigma**2), (len(missions), 1, 1)),
        switch_variable_variance=np.full(len(missions), _SWITCH_VARIANCE),
    )
    old = vi_map.loop_closure_edges
    kept = old.take(IdIndex(ids).rows(old.id) < 0)
    table = LoopClosureEdges.concatenate([kept, edges])
    return vi_map.replace(loop_closure_edges=table), tuple(missions)
