"""Alignment of missions with measured positions: yaw and position of the base frame."""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import EstimationError
from maplab_py.geometry import alignment, se3, so3
from maplab_py.vimap import VIMap

_ITERATIONS = 50
_CONVERGED = 1e-9
_LEAST_ERROR_M = 1e-3
"""Errors below this have equal weight."""
_LARGEST_TILT_DEG = 15.0
"""Largest median angle between the verticals of measured orientations and of the map."""


class Movement(NamedTuple):
    """Change of a mission's base frame by an alignment."""

    moved_m: float  # at the first vertex
    turned_deg: float  # about the vertical


def robust_yaw_position(p_G: F64, p_M: F64) -> F64:
    """Return T_G_M (7,), yaw and position, that minimises sum |p_G - T_G_M p_M| (not squared).

    The sum of distances lets up to half of the positions be wrong, and needs no threshold that a
    drifting trajectory would miss. Iteratively reweighted least squares.

    Args:
        p_G: Measured positions (N, 3).
        p_M: The positions (N, 3) in the frame of the mission.

    Raises:
        EstimationError: There are fewer than two, or they have no horizontal extent.
    """
    weight = np.ones(len(p_G))
    T_G_M = alignment.align_yaw_position(p_G, p_M)
    for _ in range(_ITERATIONS):
        error_m = np.linalg.norm(p_G - se3.transform(T_G_M, p_M), axis=1)
        weight = 1.0 / np.maximum(error_m, _LEAST_ERROR_M)
        before, T_G_M = T_G_M, alignment.align_yaw_position(p_G, p_M, weight)
        if np.max(np.abs(T_G_M - before)) < _CONVERGED:
            break
    return T_G_M


def with_aligned_base_frame(vi_map: VIMap, mission: int, T_G_M: F64) -> tuple[VIMap, Movement]:
    """Return the map with another base frame of a mission (row).

    Missions whose base frames are known move along, except those with absolute poses of their own.
    """
    before = vi_map.T_G_M[mission]
    frames = vi_map.baseframes
    mission_frame = int(vi_map.missions.baseframe[mission])
    T_new_old = se3.compose(T_G_M, se3.inverse(before))
    moves = np.zeros(len(frames), dtype=np.bool_)
    if frames.is_known[mission_frame]:
        moves = np.array(frames.is_known)
        measured = np.unique(vi_map.vertices.mission[vi_map.absolute_poses.vertex])
        moves[vi_map.missions.baseframe[measured]] = False
    moves[mission_frame] = False
    T = np.array(frames.T_G_M)
    T[moves] = se3.compose(T_new_old, T[moves])
    T[mission_frame] = T_G_M
    known = np.array(frames.is_known)
    known[mission_frame] = True
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    p_M = vi_map.vertices.T_M_I[rows[:1], 4:]
    moved = se3.transform(T_G_M, p_M) - se3.transform(before, p_M)
    turn_rad = so3.log(so3.multiply(T_G_M[:4], so3.inverse(before[:4])))
    result = vi_map.replace(baseframes=frames.replace(T_G_M=T, is_known=known))
    return result, Movement(
        float(np.linalg.norm(moved)), float(np.rad2deg(np.linalg.norm(turn_rad)))
    )


def check_vertical(R_G_S: F64, R_M_S: F64, source: str) -> None:
    """Check that measured orientations have z upwards, as those of the map do.

    Args:
        R_G_S: Measured quaternions (N, 4).
        R_M_S: Quaternions (N, 4) in the frame of the mission.
        source: Name of the file.

    Raises:
        EstimationError: They do not.
    """
    up = np.array([0.0, 0.0, 1.0])
    verticals = [so3.rotate(so3.inverse(q), up) for q in (R_G_S, R_M_S)]
    cosine = np.clip(np.sum(verticals[0] * verticals[1], axis=-1), -1.0, 1.0)
    angle_deg = float(np.median(np.rad2deg(np.arccos(cosine))))
    if angle_deg > _LARGEST_TILT_DEG:
        raise EstimationError(
            f"{source}: its vertical and that of the mission differ by {angle_deg:.0f} deg: turn it so "
            "that z points upwards, name the sensor with --sensor_id, or import it with --as=odometry"
        )
