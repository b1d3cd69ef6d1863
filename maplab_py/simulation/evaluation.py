"""How far a map is from the truth: trajectories, and where missions lie among each other."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import UserError
from maplab_py.geometry import se3, yaw
from maplab_py.geometry.alignment import align_yaw_position, umeyama
from maplab_py.report import Report
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdIndex, to_hex

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class MissionError:
    """Errors of one mission."""

    mission: str  # beginning of its id
    vertices: int
    ate_m: float  # RMSE of positions, the mission aligned by itself
    offset_m: float  # its place among the other missions is wrong by this
    yaw_deg: float  # and by this


@dataclasses.dataclass(frozen=True)
class MapErrors(Report):
    """Errors of a map against the truth."""

    missions: tuple[MissionError, ...]
    ate_each_m: float  # RMSE over all vertices, every mission aligned by itself
    ate_m: float  # RMSE over all vertices, all missions aligned together
    scale: float  # of the whole map, 1 = right


def evaluate_map(vi_map: VIMap, truth: Truth) -> MapErrors:
    """Compare the vertices of a map with the truth, by id.

    A mission's place: fit yaw and position of the mission to the truth, and of the whole map to
    the truth; offset and yaw are what differs between the two, at the middle of the mission.

    Raises:
        UserError: The truth knows none of the map's vertices.
    """
    row = IdIndex(truth.vertex_id).rows(vi_map.vertices.id)
    known = np.flatnonzero(row >= 0)
    if len(known) < 3:
        raise UserError("the truth is of another data set: it knows none of the map's vertices")
    p_G, p_true = vi_map.T_G_I[known, 4:], truth.T_G_I[row[known], 4:]
    mission = vi_map.vertices.mission[known]
    together, _ = umeyama(p_true, p_G)
    _, scale = umeyama(p_G, p_true, with_scale=True)
    level = align_yaw_position(p_true, p_G)
    errors, squares = [], 0.0
    for number in np.unique(mission):
        own = mission == number
        ate = _rmse(p_true[own], se3.transform(umeyama(p_true[own], p_G[own])[0], p_G[own]))
        squares += ate**2 * int(own.sum())
        offset, angle = _misplacement(level, p_true[own], p_G[own])
        name = to_hex(vi_map.missions.id[number])[:8]
        errors.append(MissionError(name, int(own.sum()), ate, offset, angle))
    return MapErrors(
        tuple(errors),
        float(np.sqrt(squares / len(known))),
        _rmse(p_true, se3.transform(together, p_G)),
        scale,
    )


def _misplacement(T_true_G: F64, p_true: F64, p_G: F64) -> tuple[float, float]:
    """Return how far [m], [deg] a mission sits from where the whole map's alignment puts it."""
    own = align_yaw_position(p_true, p_G)
    middle = p_G.mean(axis=0)
    gap = se3.transform(own, middle) - se3.transform(T_true_G, middle)
    turn = yaw.wrap(yaw.yaw_of(own[:4]) - yaw.yaw_of(T_true_G[:4]))
    return float(np.linalg.norm(gap)), float(abs(np.rad2deg(turn)))


def _rmse(a: F64, b: F64) -> float:
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))
