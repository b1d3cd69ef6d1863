"""Relaxation: pose-graph optimisation with loop closures; landmarks and velocities follow their vertices.

The variables are vertex poses and base frames. Between neighbours of a mission the current relative
pose is a measurement with the covariance of odometry drift; loop closures are measurements between
distant vertices, some of them false. A base frame has yaw and position. Moving it is equivalent to
moving all vertices of its mission, so the first vertex of each mission keeps position and heading
in M. Poses in G have the same optimum: it is computed for those, and then divided between base frames
and vertices. Landmarks are fixed in the body frame of their vertex, so they move rigidly with it;
velocities rotate with it; biases do not change.

False closures are detected by graduated non-convexity and a test of each (see `robust`,
`closure_consistency`), or down-weighted robustly (switchable constraints: Suenderhauf and
Protzel, IROS 2012; dynamic covariance scaling: Agarwal et al., ICRA 2013).

Use: `search_loops` of `algorithms.loop_closure` gives the edges for `loop_closures`; those are
constraints of this call only and are not added to the map. The map's own loop-closure edges always
count and stay in the map, with the verdict in their switch variables.
"""

import dataclasses
import time

import numpy as np

from maplab_py.algorithms.loop_closure import record_updates, reports, workflow
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.relaxation import map_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions, RelaxationReport, SwitchedOff
from maplab_py.algorithms.relaxation.robust import Solution, optimize_robustly
from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.estimation.problem.gauge import clusters
from maplab_py.estimation.terms.pose_graph import TiltPriors
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import IdIndex, LoopClosureEdges, VIMap, descriptors, to_hex

_NUM_WORST = 10


@dataclasses.dataclass(frozen=True, eq=False)
class Relaxed:
    """A relaxed map, and the verdict on every closure that was used."""

    vi_map: VIMap
    report: RelaxationReport
    closures: LoopClosureEdges
    weight: F64  # (E,) 1 = trusted, 0 = switched off


def relax(
    vi_map: VIMap,
    options: RelaxationOptions,
    *,
    loop_closures: LoopClosureEdges | None = None,
    missions: I64 | None = None,
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
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> Relaxed:
    """Relax the pose graph of a map.

    In each cluster of missions joined by closures the first vertex stays where it is, and the base
    frame of its mission. Missions without a usable closure do not move. Closures to missions of
    unknown base frame are ignored (closures within such a mission are not).

    Args:
        loop_closures: Closures beside those of the map, e.g. just found ones.
        missions: Mission rows that may move and whose closures count; None = all.
        progress: Where iterations are shown, and where cancellation comes from.

    Returns:
        The map with new poses, base frames, velocities and switch variables, and the report.
        Without any usable closure the map is returned as it was and the report tells so as a
        failure.

    Raises:
        EstimationError: The pose graph has no usable solution.
    """
    begin = time.perf_counter()
    tables = [vi_map.loop_closure_edges]
    if loop_closures is not None:
        tables.append(loop_closures)
    offered = LoopClosureEdges.concatenate(tables)
    closures, notes = map_edges.usable_loop_closures(vi_map, offered, missions)
    num_ignored = len(offered) - len(closures)
    if len(closures) == 0:
        nothing_done = RelaxationReport(num_ignored=num_ignored, notes=tuple(notes))
        return Relaxed(vi_map, nothing_done, closures, np.zeros(0))
    graph = map_edges.trajectory_edges(vi_map, options)
    odometry = map_edges.has_odometry_backbone(vi_map)
    loops = map_edges.loop_edges(closures, options, as_given=odometry[closures.from_vertex])
    links = [(edges.from_vertex, edges.to_vertex) for edges in (graph, loops)]
    label = clusters(len(vi_map.vertices), links)
    is_active = np.isin(label, label[loops.from_vertex])
    graph = graph.take(np.flatnonzero(is_active[graph.from_vertex]))
    anchors = _anchors(label, is_active)
    is_free = is_active.copy()
    is_free[anchors] = False
    level = np.flatnonzero(is_free & ~odometry)
    tilt = TiltPriors.of_vertices(level, vi_map.T_G_I, options.tilt_sigma_deg)
    solution = optimize_robustly(vi_map.T_G_I, is_free, graph, loops, tilt, options, progress)
    free = np.flatnonzero(is_free)
    placed, num_base_frames = _move_base_frames(vi_map, free, anchors, solution.T_G_I)
    moved = move_vertices(placed, free, solution.T_G_I)
    moved = _with_switches(moved, closures, solution.weight)
    report = dataclasses.replace(
        _report(vi_map, moved, is_active, closures, solution),
        num_ignored=num_ignored,
        num_vertices=len(free),
        num_base_frames=num_base_frames,
        num_clusters=len(anchors),
        notes=tuple(notes),
        seconds=time.perf_counter() - begin,
    )
    return Relaxed(moved, report, closures, solution.weight)


def _move_base_frames(vi_map: VIMap, rows: I64, anchors: I64, T_G_I: F64) -> tuple[VIMap, int]:
    """Turn and shift base frames so that the first vertex of each moving mission keeps its place.

    Those of missions that hold an anchor stay, unknown ones, and those that missions share.
    """
    missions, start = vi_map.missions, vi_map.vertex_start
    is_moving = mask_of(len(missions), vi_map.vertices.mission[rows])
    is_moving[vi_map.vertices.mission[anchors]] = False
    users = np.bincount(missions.baseframe, minlength=len(vi_map.baseframes))
    is_unshared = vi_map.baseframes.is_known & (users == 1)
    mission = np.flatnonzero(is_moving & is_unshared[missions.baseframe])
    if len(mission) == 0:
        return vi_map, 0
    frame, first = missions.baseframe[mission], start[mission]
    T_G_M = vi_map.baseframes.T_G_M.copy()
    T_M_I = vi_map.vertices.T_M_I[first]
    q_G_M = so3.multiply(T_G_I[first, :4], so3.inverse(T_M_I[:, :4]))
    turn = so3.multiply(q_G_M, so3.inverse(T_G_M[frame, :4]))
    about_up = np.zeros((len(mission), 3))
    about_up[:, 2] = 2.0 * np.arctan2(turn[:, 2], turn[:, 3])
    q = so3.multiply(so3.exp(about_up), T_G_M[frame, :4])
    T_G_M[frame] = se3.make(q, T_G_I[first, 4:] - so3.rotate(q, T_M_I[:, 4:]))
    return vi_map.replace(baseframes=vi_map.baseframes.replace(T_G_M=T_G_M)), len(mission)


def _with_switches(vi_map: VIMap, closures: LoopClosureEdges, weight: F64) -> VIMap:
    """Write the weights (E,) of closures into the switch variables of the map's own edges."""
    edges = vi_map.loop_closure_edges
    if len(edges) == 0:
        return vi_map
    row = IdIndex(edges.id).rows(closures.id)
    edges = edges.put(row[row >= 0], switch_variable=np.sqrt(weight[row >= 0]))
    return vi_map.replace(loop_closure_edges=edges)


def move_vertices(vi_map: VIMap, rows: I64, T_G_I: F64) -> VIMap:
    """Set the poses of some vertices (rows) in G to T_G_I[rows] of (V, 7), by their poses in M.

    Velocities turn with their vertices; landmarks follow without a change.
    """
    vertices = vi_map.vertices
    T_G_M = vi_map.T_G_M[vertices.mission[rows]]
    T_M_I = se3.relative(T_G_M, T_G_I[rows])
    turn_M = so3.multiply(T_M_I[:, :4], so3.inverse(vertices.T_M_I[rows, :4]))
    v_M = so3.rotate(turn_M, vertices.v_M[rows])
    return vi_map.replace(vertices=vertices.put(rows, T_M_I=T_M_I, v_M=v_M))


def _anchors(label: I64, is_active: Mask) -> I64:
    """Return the first active vertex of every cluster."""
    active = np.flatnonzero(is_active)
    return np.sort(active[np.unique(label[active], return_index=True)[1]])


def _report(
    before: VIMap,
    after: VIMap,
    is_active: Mask,
    closures: LoopClosureEdges,
    solution: Solution,
) -> RelaxationReport:
    old, new = before.T_G_I[is_active], after.T_G_I[is_active]
    moved_m = np.linalg.norm(new[:, 4:] - old[:, 4:], axis=1)
    turn = so3.log(so3.multiply(so3.inverse(old[:, :4]), new[:, :4]))
    turned_deg = np.rad2deg(np.linalg.norm(turn, axis=1))
    return RelaxationReport(
        num_loop_closures=len(closures),
        num_switched_off=int(np.count_nonzero(solution.weight < 0.5)),
        iterations=solution.iterations,
        cost_before=solution.cost_before,
        cost_after=solution.cost_after,
        mean_correction_m=float(moved_m.mean()),
        max_correction_m=float(moved_m.max()),
        mean_correction_deg=float(turned_deg.mean()),
        max_correction_deg=float(turned_deg.max()),
        worst=_worst(after, closures, solution.weight),
    )


def _worst(vi_map: VIMap, closures: LoopClosureEdges, weight: F64) -> tuple[SwitchedOff, ...]:
    """Describe the closures that were switched off, those farthest from the map first."""
    off = closures.take(np.flatnonzero(weight < 0.5))
    T_G_I = vi_map.T_G_I
    T_A_B = se3.relative(T_G_I[off.from_vertex], T_G_I[off.to_vertex])
    error = se3.local(off.T_A_B, T_A_B)
    error_m = np.linalg.norm(error[:, :3], axis=1)
    error_deg = np.rad2deg(np.linalg.norm(error[:, 3:], axis=1))
    is_edge = IdIndex(vi_map.loop_closure_edges.id).rows(off.id) >= 0
    return tuple(
        SwitchedOff(
            to_hex(off.id[row]), bool(is_edge[row]), float(error_m[row]), float(error_deg[row])
        )
        for row in np.argsort(-error_m, kind="stable")[:_NUM_WORST].tolist()
    )


def relax_over_loops(
    vi_map: VIMap,
    options: RelaxationOptions,
    loop_options: LoopClosureOptions,
    *,
    missions: I64 | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, reports.LoopClosureReport, RelaxationReport]:
    """Relax a map over the closures that are found in it and the edges that it has.

    The closures go into the map's record with the weight that was left to each; they do not become
    edges. A closure that is an edge of the map already counts once.

    Raises:
        EstimationError: Nothing to recognise places by, or the pose graph has no usable solution.
    """
    wanted = loop_options.type_number
    if wanted not in descriptors.types_of(vi_map.frames) and len(vi_map.loop_closure_edges):
        relaxed = relax_graph(vi_map, options, missions=missions, progress=progress)
        name = descriptors.type_name(wanted)
        note = f"the map has no {name} descriptors: only its own loop closure edges count"
        return relaxed.vi_map, reports.LoopClosureReport(notes=(note,)), relaxed.report
    search, search_report = workflow.search_loops(
        vi_map, loop_options, missions=missions, progress=progress
    )
    new = IdIndex(vi_map.loop_closure_edges.id).rows(search.edges.id) < 0
    relaxed = relax_graph(
        vi_map,
        options,
        loop_closures=search.edges.take(new),
        missions=missions,
        progress=progress,
    )
    used = IdIndex(relaxed.closures.id).rows(search.closures.id)
    result = record_updates.with_closures(
        relaxed.vi_map,
        search.closures,
        "relax",
        used=(used >= 0) & search.closures.accepted,
        weight=np.append(relaxed.weight, 1.0)[used],
    )
    return result, search_report, relaxed.report
