"""Relaxation: loop closures pull the trajectories together, everything else moves along.

The variables are vertex poses in G. Between neighbours of a mission the map's present relative pose
is a measurement with the covariance of odometry drift; loop closures are measurements between far
vertices, some of them false. Landmarks stay where they are in their vertex' body frame, so they move
rigidly with it; velocities turn with it; biases and base frames stay.

False closures are held off by robust weighting (switchable constraints: Suenderhauf and Protzel,
IROS 2012; dynamic covariance scaling: Agarwal et al., ICRA 2013). Far from the answer a true closure
looks as false as a false one, so the optimisation begins with so high a switching cost that all of
them count, and lowers it step by step (graduated non-convexity: Yang et al., RA-L 2020).

Use: `find_loop_closures` of `algorithms.loop_closure` gives the edges for `loop_closures`; those are
constraints of this call only and are not added to the map. The map's own loop-closure edges always
count, and stay in the map.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation.options import RelaxationOptions, RelaxationReport
from maplab_py.algorithms.relaxation.pose_graph import (
    RelativePoses,
    TiltPriors,
    clusters,
    has_odometry_backbone,
    loop_edges,
    trajectory_edges,
    usable_loop_closures,
)
from maplab_py.algorithms.relaxation.robust import Solution, optimize_robustly
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap
from maplab_py.vimap.tables import LoopClosureEdges

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True, eq=False)
class Relaxed:
    """A relaxed map, and what became of every closure that was used."""

    vi_map: VIMap
    report: RelaxationReport
    closures: LoopClosureEdges
    weight: F64  # (E,) 1 = trusted, 0 = switched off


def relax(
    vi_map: VIMap,
    options: RelaxationOptions,
    *,
    loop_closures: LoopClosureEdges | None = None,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, RelaxationReport]:
    """Relax the pose graph of a map; as `relax_graph`, for those who need no switches.

    Raises:
        EstimationError: The pose graph has no usable solution.
    """
    relaxed = relax_graph(
        vi_map, options, loop_closures=loop_closures, missions=missions, progress=progress
    )
    return relaxed.vi_map, relaxed.report


def relax_graph(
    vi_map: VIMap,
    options: RelaxationOptions,
    *,
    loop_closures: LoopClosureEdges | None = None,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> Relaxed:
    """Relax the pose graph of a map.

    In each cluster of missions joined by closures the first vertex stays where it is. Missions
    without a usable closure do not move. Closures to missions of unknown base frame are ignored
    (closures within such a mission are not).

    Args:
        vi_map: The map.
        options: Drift rates and robustness.
        loop_closures: Closures beside those of the map, e.g. just found ones.
        missions: Mission rows that may move and whose closures count; None = all.
        progress: Where iterations are shown, and where cancellation comes from.

    Returns:
        The map with new poses and velocities, and the report. Without any usable closure the map is
        returned as it was and the report tells so as a failure.

    Raises:
        EstimationError: The pose graph has no usable solution.
    """
    begin = time.perf_counter()
    tables = [vi_map.loop_closure_edges]
    if loop_closures is not None:
        tables.append(loop_closures)
    offered = LoopClosureEdges.concatenate(tables)
    closures, notes = usable_loop_closures(vi_map, offered, missions)
    num_ignored = len(offered) - len(closures)
    if len(closures) == 0:
        return Relaxed(vi_map, _nothing_done(num_ignored, notes), closures, np.zeros(0))
    graph = trajectory_edges(vi_map, options)
    odometry = has_odometry_backbone(vi_map)
    loops = loop_edges(closures, options, as_given=odometry[closures.from_vertex])
    label = clusters(len(vi_map.vertices), [graph, loops])
    is_active = np.isin(label, label[loops.from_vertex])
    graph = graph.take(np.flatnonzero(is_active[graph.from_vertex]))
    anchors = _anchors(label, is_active)
    is_free = is_active.copy()
    is_free[anchors] = False
    level = np.flatnonzero(is_free & ~odometry)
    tilt = TiltPriors.of_vertices(level, vi_map.T_G_I, options.tilt_sigma_deg)
    solution = optimize_robustly(vi_map.T_G_I, is_free, graph, loops, tilt, options, progress)
    moved = move_vertices(vi_map, np.flatnonzero(is_free), solution.T_G_I)
    report = _report(vi_map, moved, is_active, len(anchors), loops, solution, num_ignored, notes)
    report = dataclasses.replace(report, seconds=time.perf_counter() - begin)
    return Relaxed(moved, report, closures, solution.weight)


def move_vertices(vi_map: VIMap, rows: I64, T_G_I: F64) -> VIMap:
    """Give some vertices (rows) the poses T_G_I[rows] of (V, 7); base frames stay.

    Velocities turn with their vertices; landmarks follow without a change.
    """
    vertices = vi_map.vertices
    T_G_M = vi_map.T_G_M[vertices.mission[rows]]
    T_M_I = se3.relative(T_G_M, T_G_I[rows])
    turn_M = so3.multiply(T_M_I[:, :4], so3.inverse(vertices.T_M_I[rows, :4]))
    poses, velocities = vertices.T_M_I.copy(), vertices.v_M.copy()
    poses[rows] = T_M_I
    velocities[rows] = so3.rotate(turn_M, vertices.v_M[rows])
    return vi_map.replace(vertices=vertices.replace(T_M_I=poses, v_M=velocities))


def _anchors(label: I64, is_active: NDArray[np.bool_]) -> I64:
    """Return the first active vertex of every cluster."""
    active = np.flatnonzero(is_active)
    return np.sort(active[np.unique(label[active], return_index=True)[1]])


def _report(
    before: VIMap,
    after: VIMap,
    is_active: NDArray[np.bool_],
    num_clusters: int,
    loops: RelativePoses,
    solution: Solution,
    num_ignored: int,
    notes: list[str],
) -> RelaxationReport:
    old, new = before.T_G_I[is_active], after.T_G_I[is_active]
    moved_m = np.linalg.norm(new[:, 4:] - old[:, 4:], axis=1)
    turn = so3.log(so3.multiply(so3.inverse(old[:, :4]), new[:, :4]))
    return RelaxationReport(
        num_loop_closures=len(loops),
        num_switched_off=int(np.count_nonzero(solution.weight < 0.5)),
        num_ignored=num_ignored,
        num_vertices=int(np.count_nonzero(is_active)) - num_clusters,
        num_clusters=num_clusters,
        iterations=solution.iterations,
        cost_before=solution.cost_before,
        cost_after=solution.cost_after,
        mean_correction_m=float(moved_m.mean()),
        max_correction_m=float(moved_m.max()),
        max_correction_deg=float(np.rad2deg(np.linalg.norm(turn, axis=1).max())),
        seconds=0.0,
        notes=tuple(notes),
    )


def _nothing_done(num_ignored: int, notes: list[str]) -> RelaxationReport:
    return RelaxationReport(
        num_loop_closures=0,
        num_switched_off=0,
        num_ignored=num_ignored,
        num_vertices=0,
        num_clusters=0,
        iterations=0,
        cost_before=0.0,
        cost_after=0.0,
        mean_correction_m=0.0,
        max_correction_m=0.0,
        max_correction_deg=0.0,
        seconds=0.0,
        notes=tuple(notes),
    )
