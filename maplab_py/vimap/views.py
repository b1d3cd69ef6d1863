"""Rows as small objects, for plugin authors and tests; algorithms work on whole columns."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.tables import LandmarkQuality

if TYPE_CHECKING:
    from maplab_py.vimap.vi_map import VIMap


@dataclasses.dataclass(frozen=True, eq=False)
class MissionView:
    """One mission."""

    row: int
    id: str
    T_G_M: F64  # (7,)
    is_T_G_M_known: bool
    vertices: range  # rows


@dataclasses.dataclass(frozen=True, eq=False)
class VertexView:
    """One vertex."""

    row: int
    id: str
    mission: int  # row
    timestamp_ns: int
    T_M_I: F64  # (7,)
    T_G_I: F64  # (7,)
    v_M: F64  # (3,) [m/s]
    accel_bias: F64  # (3,) [m/s^2]
    gyro_bias: F64  # (3,) [rad/s]
    frames: range  # rows


@dataclasses.dataclass(frozen=True, eq=False)
class LandmarkView:
    """One landmark."""

    row: int
    id: str
    vertex: int  # row of the vertex that stores it
    p_I: F64  # (3,) in that vertex' body frame [m]
    p_G: F64  # (3,) [m]
    quality: LandmarkQuality
    keypoints: NDArray[np.int64]  # rows of its observations


def mission_view(vi_map: VIMap, row: int) -> MissionView:
    """Return mission `row`; negative rows count from the end."""
    row = range(len(vi_map.missions))[row]
    baseframe = vi_map.missions.baseframe[row]
    return MissionView(
        row=row,
        id=to_hex(vi_map.missions.id[row]),
        T_G_M=vi_map.baseframes.T_G_M[baseframe],
        is_T_G_M_known=bool(vi_map.baseframes.is_known[baseframe]),
        vertices=range(int(vi_map.vertex_start[row]), int(vi_map.vertex_start[row + 1])),
    )


def vertex_view(vi_map: VIMap, row: int) -> VertexView:
    """Return vertex `row`; negative rows count from the end."""
    row = range(len(vi_map.vertices))[row]
    v = vi_map.vertices
    return VertexView(
        row=row,
        id=to_hex(v.id[row]),
        mission=int(v.mission[row]),
        timestamp_ns=int(v.timestamp_ns[row]),
        T_M_I=v.T_M_I[row],
        T_G_I=vi_map.T_G_I[row],
        v_M=v.v_M[row],
        accel_bias=v.accel_bias[row],
        gyro_bias=v.gyro_bias[row],
        frames=range(int(vi_map.frame_start[row]), int(vi_map.frame_start[row + 1])),
    )


def landmark_view(vi_map: VIMap, row: int) -> LandmarkView:
    """Return landmark `row`; negative rows count from the end."""
    row = range(len(vi_map.landmarks))[row]
    table, start = vi_map.landmarks, vi_map.observation_start
    return LandmarkView(
        row=row,
        id=to_hex(table.id[row]),
        vertex=int(table.vertex[row]),
        p_I=table.p_I[row],
        p_G=vi_map.p_G[row],
        quality=LandmarkQuality(int(table.quality[row])),
        keypoints=vi_map.observations[start[row] : start[row + 1]],
    )
