"""Trajectories, vertices, and the edges between them."""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I32, U8
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import (
    PATH_ENDS,
    Drawing,
    axis_lines,
    make_points,
    make_segments,
    spread_rows,
)
from maplab_py.viewer.scene import WHOLE_MAP, Axes, Entity, Layer, LegendEntry, Part, Segments
from maplab_py.vimap import TransformationKind

_EDGE_COLOURS = colours.from_hex("#7f9cc0", "#5fa39a", "#b08a5a", "#9a86b8")
_END_COLOURS = colours.from_hex("#3fa372", "#d2455a")  # start, end
_MAX_LABELLED_MISSIONS = 8
"""The labels of more missions would hide the map."""


def trajectories(drawing: Drawing) -> Layer:
    """Lines through the vertices of each mission, in its colour or by time."""
    mission, p = drawing.vi_map.vertices.mission, drawing.p_vertices
    start = np.flatnonzero(mission[1:] == mission[:-1])
    colour, legend = _vertex_colours(drawing)
    ends = p[start], p[start + 1]
    parts = drawing.segments(mission[start], *ends, colour[start], start, 3.0)
    count = len(drawing.vi_map.missions)
    return Layer("trajectories", "Trajectories", parts, count, legend=legend)


def _vertex_colours(drawing: Drawing) -> tuple[U8, tuple[LegendEntry, ...]]:
    """Return a colour (V, 3) for each vertex, of its mission or by the time since that began."""
    table, start = drawing.vi_map.vertices, drawing.vi_map.vertex_start
    if not drawing.options.color_paths_by_time:
        return drawing.mission_colours[table.mission], ()
    since_ns = table.timestamp_ns - table.timestamp_ns[start[table.mission]]
    part, low, high = colours.normalised(np.asarray(1e-9 * since_ns, dtype=np.float64))
    ends = f"{low:.0f} s", f"{high:.0f} s"
    legend = LegendEntry.ramp("time of the path", colours.SEQUENTIAL, *ends)
    return colours.ramp(part, colours.SEQUENTIAL), (legend,)


def vertices(drawing: Drawing) -> Layer:
    """A dot for each vertex, in the colour of the path."""
    mission = drawing.vi_map.vertices.mission
    colour, _ = _vertex_colours(drawing)
    rows, size_m = np.arange(len(mission)), 0.0045 * drawing.unit_m
    parts = drawing.points(mission, drawing.p_vertices, colour, rows, size_m)
    return Layer("vertices", "Vertices", parts, len(mission), Entity.VERTEX)


def path_ends(drawing: Drawing) -> Layer:
    """A dot and a label where each mission starts and where it ends."""
    start = drawing.vi_map.vertex_start
    p = drawing.p_vertices
    has_vertices = np.flatnonzero(np.diff(start) > 0)
    parts: dict[str, Part] = {}
    for mission in has_vertices.tolist():
        rows = np.array([start[mission], start[mission + 1] - 1], dtype=np.int64)
        dots = make_points(p[rows], _END_COLOURS, rows, 0.018 * drawing.unit_m)
        labels: tuple[str, ...] = ()
        if len(has_vertices) <= _MAX_LABELLED_MISSIONS and len(dots) == 2:
            name = f" {drawing.mission_names[mission]}" if len(has_vertices) > 1 else ""
            is_closed = np.linalg.norm(p[rows[1]] - p[rows[0]]) < 0.05 * drawing.unit_m
            labels = ("start" + name, "end" + name)
            if is_closed:
                labels = (f"start and end{name}",)
        parts[drawing.mission_ids[mission]] = dataclasses.replace(dots, labels=labels)
    return Layer(PATH_ENDS, "Start and end", parts, 2 * len(has_vertices), Entity.VERTEX)


def imu_edges(drawing: Drawing) -> Layer:
    """The inertial edges."""
    edges = drawing.vi_map.imu_edges
    parts = _edge_parts(drawing, edges.from_vertex, edges.to_vertex, 0)
    return Layer("imu_edges", "IMU edges", parts, len(edges), is_visible=False)


def transformation_edges(drawing: Drawing) -> list[Layer]:
    """The relative-pose edges, one layer per kind that occurs."""
    edges = drawing.vi_map.transformation_edges
    titles = {
        TransformationKind.ODOMETRY: "Odometry edges",
        TransformationKind.WHEEL_ODOMETRY: "Wheel odometry edges",
        TransformationKind.TRANSFORMATION: "Transformation edges",
    }
    layers = []
    for place, (kind, title) in enumerate(titles.items(), start=1):
        rows = np.flatnonzero(edges.kind == kind)
        if len(rows):
            ends = edges.from_vertex[rows], edges.to_vertex[rows]
            parts = _edge_parts(drawing, *ends, place)
            name = title.lower().replace(" ", "_")
            layers.append(Layer(name, title, parts, len(rows), is_visible=False))
    return layers


def _edge_parts(drawing: Drawing, start: I32, end: I32, colour: int) -> dict[str, Segments]:
    known = np.flatnonzero((start >= 0) & (end >= 0))
    mission = drawing.vi_map.vertices.mission[start[known]]
    p_start, p_end = drawing.p_vertices[start[known]], drawing.p_vertices[end[known]]
    return drawing.segments(mission, p_start, p_end, _EDGE_COLOURS[colour], known, 2.0)


def loop_closures(drawing: Drawing) -> Layer:
    """The loop closure edges, coloured by how far they are trusted."""
    edges = drawing.vi_map.loop_closure_edges
    p = drawing.p_vertices
    rows = np.flatnonzero((edges.from_vertex >= 0) & (edges.to_vertex >= 0))
    colour = colours.ramp(edges.switch_variable[rows], colours.TRUST)
    part = make_segments(p[edges.from_vertex[rows]], p[edges.to_vertex[rows]], colour, rows, 2.5)
    legend = (LegendEntry.ramp("switch value", colours.TRUST, "0", "1"),)
    parts, entity = {WHOLE_MAP: part}, Entity.LOOP_CLOSURE
    return Layer("loop_closures", "Loop closures", parts, len(edges), entity, legend=legend)


def base_frames(drawing: Drawing) -> Layer:
    """T_G_M of each mission, labelled with its name."""
    T = drawing.vi_map.T_G_M.copy()
    T[:, 4:] += drawing.shift
    known = drawing.vi_map.baseframes.is_known[drawing.vi_map.missions.baseframe]
    parts: dict[str, Part] = {}
    for row, mission_id in enumerate(drawing.mission_ids):
        label = drawing.mission_names[row] + ("" if known[row] else " (base frame unknown)")
        parts[mission_id] = Axes(T[row : row + 1], 0.06 * drawing.unit_m, (label,))
    return Layer("base_frames", "Base frames", parts, len(T), is_visible=False)


def absolute_poses(drawing: Drawing) -> Layer:
    """Absolute pose measurements, each as axes at T_G_S."""
    table = drawing.vi_map.absolute_poses
    mission = drawing.vi_map.vertices.mission[table.vertex]
    parts: dict[str, Part] = {}
    for mission_id, rows in drawing.by_mission(mission):
        T = table.T_G_S[rows].copy()
        T[:, 4:] += drawing.shift[mission[rows]]
        parts[mission_id] = axis_lines(T, rows, 0.02 * drawing.unit_m)
    return Layer("absolute_poses", "Absolute pose measurements", parts, len(table))


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
