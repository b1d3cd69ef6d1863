"""Anchor missions by their absolute poses: markers, satellite positions, poses of another program.

Absolute poses are measured in G, so a mission with absolute poses needs no other mission. As in maplab
they precede anchoring by places. The alignment minimises the sum of distances, which tolerates up to half
of the measurements as outliers; it needs no random samples.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.algorithms.external_poses import alignment
from maplab_py.array_types import F64, I32, I64, U64, Mask
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.options import Options
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id, to_hex

_PARTS = (slice(0, 3), slice(3, 6))
"""Position and orientation in a covariance."""
_SIGMAS = 3.0
"""Standard deviations that a measurement may be off beyond the limits."""
_KNOWN_ORIENTATION_RAD = 1.0
"""Orientations of larger deviations were not measured, as those of satellite receivers."""


class AbsoluteAnchoringOptions(Options, prefix="abs_constraints_baseframe_"):
    """Conditions under which absolute poses determine a mission's base frame, with maplab's names."""

    min_number_of_constraints: int = 3
    """Absolute poses that a mission must have to be anchored by them"""
    min_inlier_ratio: float = 0.5
    """Ratio of the absolute poses of a mission that must agree"""
    ransac_max_position_error_m: float = 2.0
    """Largest error of positions that agree, beyond three standard deviations; as large as the drift of the
    mission"""
    ransac_max_orientation_error_rad: float = 0.0872
    """Largest error of measured orientations, likewise"""


class AbsoluteAnchoring(NamedTuple):
    """A map whose missions with absolute poses are anchored."""

    vi_map: VIMap
    anchored: Mask  # (M,)
    refused: dict[int, str]  # mission: why its absolute poses do not anchor it


def anchor_by_absolute_poses(
    vi_map: VIMap, missions: Mask, options: AbsoluteAnchoringOptions
) -> AbsoluteAnchoring:
    """Move the base frames of missions (M,) that have absolute poses, and mark them as known.

    Missions without absolute poses stay as they are.
    """
    anchored = np.zeros(len(vi_map.missions), dtype=np.bool_)
    refused: dict[int, str] = {}
    of_mission = vi_map.vertices.mission[vi_map.absolute_poses.vertex]
    for mission in np.flatnonzero(missions).tolist():
        rows = np.flatnonzero(of_mission == mission)
        if not len(rows):
            continue
        T_G_M, reason = _alignment(vi_map, mission, rows, options)
        if reason:
            refused[mission] = reason
            continue
        vi_map, _ = alignment.with_aligned_base_frame(vi_map, mission, T_G_M)
        anchored[mission] = True
    return AbsoluteAnchoring(vi_map, anchored, refused)


def _alignment(
    vi_map: VIMap, mission: int, rows: I64, options: AbsoluteAnchoringOptions
) -> tuple[F64, str]:
    """Return T_G_M (7,) of a mission by its absolute poses (rows), or the reason why there is none."""
    if len(rows) < options.min_number_of_constraints:
        return se3.identity(), (
            f"{len(rows)} absolute poses, --abs_constraints_baseframe_min_number_of_constraints="
            f"{options.min_number_of_constraints}"
        )
    table = vi_map.absolute_poses.take(rows)
    T_M_S = _T_M_S(vi_map, mission, table.vertex, table.sensor_id)
    try:
        T_G_M = alignment.robust_yaw_position(table.T_G_S[:, 4:], T_M_S[:, 4:])
    except EstimationError as error:
        return se3.identity(), f"absolute poses: {error}"
    agrees = _agreeing(table.T_G_S, se3.compose(T_G_M, T_M_S), table.covariance, options)
    ratio = float(np.mean(agrees))
    if ratio < options.min_inlier_ratio:
        return se3.identity(), (
            f"{np.count_nonzero(agrees)} of {len(rows)} absolute poses agree, "
            f"--abs_constraints_baseframe_min_inlier_ratio={options.min_inlier_ratio:g}"
        )
    return T_G_M, ""


def _T_M_S(vi_map: VIMap, mission: int, vertices: I32, sensor_id: U64) -> F64:
    """Return the estimated poses (N, 7) of the sensors in the frame of the mission."""
    imu_id = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    words, row = np.unique(sensor_id, axis=0, return_inverse=True)
    known = vi_map.sensors.sensors
    T_I_S = np.stack(
        [
            vi_map.sensors.T_I_S(imu_id, name)
            if (name := to_hex(word)) in known
            else se3.identity()
            for word in words
        ]
    )
    return se3.compose(vi_map.vertices.T_M_I[vertices], T_I_S[row.reshape(-1)])


def _agreeing(
    measured: F64, T_G_S: F64, covariance: F64, options: AbsoluteAnchoringOptions
) -> Mask:
    """Return which measurements (N, 7) are near the poses (N, 7)."""
    usable = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    variance = np.diagonal(np.where(usable, covariance, 0.0), axis1=1, axis2=2)
    sigma_m, sigma_rad = (np.sqrt(variance[:, part].max(axis=1)) for part in _PARTS)
    off_m = np.linalg.norm(measured[:, 4:] - T_G_S[:, 4:], axis=1)
    turn = so3.log(so3.multiply(so3.inverse(measured[:, :4]), T_G_S[:, :4]))
    off_rad = np.linalg.norm(turn, axis=1)
    is_near = off_m <= options.ransac_max_position_error_m + _SIGMAS * sigma_m
    is_turned = off_rad > options.ransac_max_orientation_error_rad + _SIGMAS * sigma_rad
    return np.asarray(is_near & ~(is_turned & (sigma_rad < _KNOWN_ORIENTATION_RAD)))
