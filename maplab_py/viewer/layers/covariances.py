"""Covariances of positions as ellipsoids: three principal ellipses each."""

import numpy as np

from maplab_py.array_types import F64, I64, U8
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.viewer import colours
from maplab_py.viewer.drawing import Drawing, make_segments
from maplab_py.viewer.scene import WHOLE_MAP, Entity, Layer, Part, Segments

LOOP_CLOSURES, ABSOLUTE_POSES = "loop_closure_covariances", "absolute_pose_covariances"
_CIRCLE_POINTS = 24
_MAX_ELLIPSOIDS = 3000
_LINE_PX = 1.0


def covariance_layers(drawing: Drawing) -> list[Layer]:
    """The covariances that the options ask for."""
    layers = []
    if drawing.options.lc_edge_covariances:
        layers.append(loop_closure_covariances(drawing))
    if drawing.options.abs_6dof_constraint_covariances:
        layers.append(absolute_pose_covariances(drawing))
    return layers


def loop_closure_covariances(drawing: Drawing) -> Layer:
    """An ellipsoid where each loop closure edge sees its to-vertex from its from-vertex."""
    vi_map, edges = drawing.vi_map, drawing.vi_map.loop_closure_edges
    is_usable = _is_finite(edges.covariance) & (edges.from_vertex >= 0)
    usable = np.flatnonzero(is_usable & (edges.to_vertex >= 0))
    rows, title = _thin(usable, "Loop closure covariances")
    start = edges.from_vertex[rows]
    T_G_A = vi_map.T_G_I[start]
    centre = se3.transform(T_G_A, edges.T_A_B[rows, 4:])
    centre = centre + drawing.shift[vi_map.vertices.mission[start]]
    R_G_A = so3.to_matrix(T_G_A[:, :4])
    # a change dp of p_A_B is in A
    covariance = R_G_A @ edges.covariance[rows, :3, :3] @ np.swapaxes(R_G_A, 1, 2)
    colour = colours.ramp(edges.switch_variable[rows], colours.TRUST)
    scale = drawing.options.covariance_scale
    parts = {WHOLE_MAP: ellipsoids(centre, covariance, colour, rows, scale)}
    return Layer(LOOP_CLOSURES, title, parts, len(usable), Entity.LOOP_CLOSURE)


def absolute_pose_covariances(drawing: Drawing) -> Layer:
    """An ellipsoid at each absolute pose measurement."""
    table = drawing.vi_map.absolute_poses
    usable = np.flatnonzero(_is_finite(table.covariance))
    rows, title = _thin(usable, "Absolute pose covariances")
    mission = drawing.vi_map.vertices.mission[table.vertex[rows]]
    parts: dict[str, Part] = {}
    for mission_id, places in drawing.by_mission(mission):
        members = rows[places]
        home = mission[places[0]]
        parts[mission_id] = ellipsoids(
            table.T_G_S[members, 4:] + drawing.shift[home],
            table.covariance[members, :3, :3],
            drawing.mission_colours[home],
            members,
            drawing.options.covariance_scale,
        )
    return Layer(ABSOLUTE_POSES, title, parts, len(usable))


def ellipsoids(centre: F64, covariance: F64, colour: U8, rows: I64, scale: float) -> Segments:
    """Return the surfaces of equal Mahalanobis distance as ellipses in their principal planes.

    Args:
        centre: Centres (N, 3) [m].
        covariance: Covariances (N, 3, 3) [m^2]; negative eigenvalues count as zero.
        colour: A colour (3,), or a colour of each (N, 3).
        rows: Rows (N,) of the map's table.
        scale: Half axes in standard deviations.
    """
    variance, axes = symmetric.eigen(covariance)
    half_axes = scale * np.sqrt(np.maximum(variance, 0.0))[:, None, :] * axes  # columns (N, 3, 3)
    points = centre[:, None, None, :] + np.einsum("nij,ckj->ncki", half_axes, _unit_circles())
    start, end = points, np.roll(points, -1, axis=2)
    per_ellipsoid = 3 * _CIRCLE_POINTS
    every = np.repeat(np.broadcast_to(colour, (len(rows), 3)), per_ellipsoid, axis=0)
    return make_segments(
        start.reshape(-1, 3), end.reshape(-1, 3), every, np.repeat(rows, per_ellipsoid), _LINE_PX
    )


def _unit_circles() -> F64:
    """Return the unit circles (3, K, 3) in the planes of the axes 1 and 2, 2 and 0, 0 and 1."""
    angle = np.linspace(0.0, 2.0 * np.pi, _CIRCLE_POINTS, endpoint=False)
    circle = np.stack([np.zeros_like(angle), np.cos(angle), np.sin(angle)], axis=1)
    return np.stack([np.roll(circle, shift, axis=1) for shift in range(3)])


def _is_finite(covariance: F64) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Tell which covariances (N, 6, 6) have a position part."""
    return np.asarray(np.isfinite(covariance[:, :3, :3]).all(axis=(1, 2)))


def _thin(rows: I64, title: str) -> tuple[I64, str]:
    """Return as many of the rows as a page can draw, and the title of their layer."""
    step = max(-(-len(rows) // _MAX_ELLIPSOIDS), 1)
    return rows[::step], f"{title} (one of {step})" if step > 1 else title
