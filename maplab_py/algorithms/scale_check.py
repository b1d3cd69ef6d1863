"""Scale of a map compared with its accelerometers, which a collapsed map contradicts.

Three consecutive vertices give an acceleration by their positions and another by their IMU samples. The
former is regressed on the latter: noise of the positions does not bias the slope, and samples have little
noise.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.estimation.imu.preintegration import integrate
from maplab_py.geometry import so3
from maplab_py.vimap import VIMap

_MIN_CHANGES = 30
_LONGEST_S = 2.0
"""Longer edges are not integrated well enough."""
_ROUNDS = 3
_LEAST_ACCELERATION_MPS2 = 0.1
"""Of slower motion, accelerometers say nothing about the scale."""
_SMALLEST, _LARGEST = 0.7, 1.4
"""Scales beyond which a map cannot be right; real ones have 0.94 to 1.01."""


@dataclasses.dataclass(frozen=True)
class MissionScale:
    """Scale of one mission: lengths of the map as multiples of those by the IMU."""

    mission: int  # row
    scale: float

    @property
    def doubt(self) -> str:
        """Return the contradiction in words; empty if there is none."""
        if _SMALLEST <= self.scale <= _LARGEST:
            return ""
        return (
            f"lengths are {self.scale:.2g} times what the accelerometer says: the map has collapsed or is "
            "bent; check the IMU's noise and the time offset, and optimise the map of the odometry again"
        )


def mission_scales(vi_map: VIMap) -> tuple[MissionScale, ...]:
    """Return the scale of every mission whose motion shows it."""
    edges = vi_map.imu_edges
    from_vertex, to_vertex = (
        column.astype(np.int64) for column in (edges.from_vertex, edges.to_vertex)
    )
    first, second = _consecutive(from_vertex, to_vertex)
    if len(first) < _MIN_CHANGES:
        return ()
    vertices = vi_map.vertices
    data = InertialData.of_map(vi_map)
    of_edge = from_vertex
    motion = integrate(data, vertices.gyro_bias[of_edge], vertices.accel_bias[of_edge])
    dt = motion.duration_s[:, None]
    is_short = (dt[:, 0] > 0.0) & (dt[:, 0] < _LONGEST_S)
    kept = is_short[first] & is_short[second]
    first, second = first[kept], second[kept]
    R = so3.to_matrix(vertices.T_M_I[of_edge, :4])
    safe = np.maximum(dt, 1e-9)
    mean = (
        np.einsum("eij,ej->ei", R, motion.dp) / safe
    )  # of the velocity, that at the start removed
    gain = np.einsum("eij,ej->ei", R, motion.dv)
    p = vertices.T_M_I[:, 4:]
    by_map = (p[to_vertex] - p[of_edge]) / safe
    half = 0.5 * (dt[first] + dt[second])
    gravity = np.array([imu.gravity_magnitude_mps2 for imu in data.imus])[data.imu_of_edge[first]]
    imu = (gain[first] + mean[second] - mean[first]) / half
    imu[:, 2] -= gravity
    change = (by_map[second] - by_map[first]) / half
    mission = vertices.mission[of_edge[first]]
    scales = []
    for row in np.unique(mission).tolist():
        rows = mission == row
        if np.count_nonzero(rows) >= _MIN_CHANGES:
            scale, size = _slope(imu[rows], change[rows])
            if size >= _LEAST_ACCELERATION_MPS2:
                scales.append(MissionScale(row, scale))
    return tuple(scales)


def scale_doubts(vi_map: VIMap) -> tuple[str, ...]:
    """Return a line for each mission whose scale contradicts its accelerometer."""
    return tuple(
        f"mission {of.mission + 1} of {len(vi_map.missions)}: {of.doubt}"
        for of in mission_scales(vi_map)
        if of.doubt
    )


def _consecutive(from_vertex: I64, to_vertex: I64) -> tuple[I64, I64]:
    """Return pairs of edges (rows) of which the second begins where the first ends."""
    order = np.argsort(from_vertex, kind="stable")
    at = np.searchsorted(from_vertex[order], to_vertex)
    inside = np.flatnonzero(at < len(order))
    follows = from_vertex[order[at[inside]]] == to_vertex[inside]
    return inside[follows], order[at[inside[follows]]]


def _slope(first: F64, second: F64) -> tuple[float, float]:
    """Return the slope of the second vectors (N, 3) over the first, and the root mean square of the first.

    A twentieth of them, where the difference is largest, is left out: there the map jumps.
    """
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    slope, rows = 1.0, np.arange(len(first))
    for _ in range(_ROUNDS):
        power = float(np.vdot(first[rows], first[rows])) + 1e-12
        slope = float(np.vdot(first[rows], second[rows])) / power
        off = np.linalg.norm(second - slope * first, axis=1)
        rows = np.argsort(off, kind="stable")[: max(1, round(0.95 * len(off)))]
    return slope, float(np.sqrt(np.mean(np.sum(first[rows] ** 2, axis=1))))
