"""Missions that stand still: an edge ties their first and last vertex, so that they do not drift."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.loop_closure.record_updates import closure_ids
from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.geometry import se3
from maplab_py.vimap import LoopClosureEdges, VIMap
from maplab_py.vimap.ids import IdIndex, to_hex

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
