"""Spread missions with unknown base frame in space for visualisation."""

import numpy as np

from maplab_py.array_types import I64
from maplab_py.geometry import se3, so3
from maplab_py.options import Options, option
from maplab_py.report import Report
from maplab_py.vimap import VIMap


class LayoutOptions(Options, prefix="spatially_distribute_missions_"):
    """Layout of missions with unknown base frame; maplab's names and defaults."""

    meters: float = option(20.0, unit="m")
    """Distance of neighbours, or radius of the circle."""
    dimension: int = option(0, ge=0, le=2)
    """Axis to shift along: 0 = x, 1 = y, 2 = z."""
    around_circle: bool = False
    """Spread the missions around a circle instead."""


def distribute_missions(vi_map: VIMap, options: LayoutOptions) -> tuple[VIMap, int]:
    """Shift the base frames of missions whose base frame is unknown; return how many there are.

    The i-th mission moves to i times the distance along the axis, or to the i-th place on the circle;
    the orientation of its base frame does not change.
    """
    frames = vi_map.baseframes
    rows = vi_map.missions.baseframe[~frames.is_known[vi_map.missions.baseframe]]
    if len(rows) == 0:
        return vi_map, 0
    number = np.arange(len(rows))
    place = np.zeros((len(rows), 3))
    if options.around_circle:
        angle = 2.0 * np.pi * number / len(rows)
        place[:, 0] = options.meters * np.cos(angle)
        place[:, 1] = options.meters * np.sin(angle)
    else:
        place[:, options.dimension] = options.meters * (number + 1)
    moved = frames.put((rows, slice(4, None)), T_G_M=place)
    return vi_map.replace(baseframes=moved), len(rows)


class DisturbanceOptions(Options, prefix="disturb_"):
    """Magnitude of the disturbance; maplab's names and defaults."""

    max_translational_disturbance_norm_m: float = option(0.05, ge=0)
    """Largest shift of a vertex."""
    max_yaw_angle_rad: float = option(0.05, ge=0)
    """Largest turn of a vertex."""
    translation_random_walk_sigma_m: float = option(0.005, ge=0)
    """Standard deviation by which the shift changes per vertex and axis."""
    yaw_angle_stddev_rad: float = option(0.0005, ge=0)
    """Standard deviation by which the turn changes per vertex."""
    random_generator_seed: int = option(0, ge=0)
    """Seed of the disturbance."""


class DisturbanceReport(Report):
    """Magnitude of the applied disturbance."""

    vertices: int
    largest_shift_m: float
    mean_shift_m: float
    largest_turn_rad: float


def disturb_vertices(
    vi_map: VIMap, options: DisturbanceOptions, *, missions: I64 | None = None
) -> tuple[VIMap, DisturbanceReport]:
    """Disturb the position and yaw of vertices by random walks that start at each first vertex.

    Landmarks move with the vertices that store them; velocities rotate with their vertex.
    """
    v = vi_map.vertices
    T_M_I, v_M = v.T_M_I.copy(), v.v_M.copy()
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    shift, turn = np.zeros((len(v), 3)), np.zeros(len(v))
    for mission in rows.tolist():
        rng = np.random.default_rng([options.random_generator_seed, mission])
        mine = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
        walk = np.cumsum(rng.normal(size=(len(mine), 4)), axis=0)
        walk -= walk[:1]
        moved = walk[:, :3] * options.translation_random_walk_sigma_m
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        limit = options.max_translational_disturbance_norm_m
        shift[mine] = moved * np.minimum(1.0, limit / np.maximum(length, 1e-300))
        most = options.max_yaw_angle_rad
        turn[mine] = np.clip(walk[:, 3] * options.yaw_angle_stddev_rad, -most, most)
    axis = np.zeros((len(v), 3))
    axis[:, 2] = turn
    q = so3.exp(axis)
    T_M_I = se3.make(so3.multiply(q, T_M_I[:, :4]), T_M_I[:, 4:] + shift)
    result = vi_map.replace(vertices=v.replace(T_M_I=T_M_I, v_M=so3.rotate(q, v_M)))
    size = np.linalg.norm(shift, axis=1)
    report = DisturbanceReport(
        vertices=int(np.isin(v.mission, rows).sum()),
        largest_shift_m=float(size.max(initial=0.0)),
        mean_shift_m=float(size.mean()) if len(size) else 0.0,
        largest_turn_rad=float(np.abs(turn).max(initial=0.0)),
    )
    return result, report
