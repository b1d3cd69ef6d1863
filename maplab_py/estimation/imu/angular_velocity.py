"""Angular velocity at the vertices of a map, from the nearest inertial samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import F64
from maplab_py.estimation.imu.inertial_data import InertialData
from maplab_py.vimap import VIMap


def angular_velocity_at_vertices(vi_map: VIMap, vertices: NDArray[np.integer] | None = None) -> F64:
    """Return the angular velocity (V, 3) in I [rad/s], biases and intrinsics taken off.

    The first sample of the edge that leaves a vertex counts, else the last of the one that arrives;
    a vertex without either is taken to stand still.

    Args:
        vi_map: Map.
        vertices: Vertices whose velocities are wanted, None = all; those of others may be zero.
    """
    result = np.zeros((len(vi_map.vertices), 3))
    table = vi_map.imu_edges
    wanted = np.zeros(len(result), dtype=np.bool_)
    wanted[slice(None) if vertices is None else vertices] = True
    is_near = wanted[table.from_vertex] | wanted[table.to_vertex]
    edges = np.flatnonzero((table.sample_count > 0) & is_near)
    data = InertialData.of_map(vi_map, edges)
    if not len(edges):
        return result
    gyro_corrections = data.corrections[0][data.imu_of_edge]
    last, first = data.sample_start[1:] - 1, data.sample_start[:-1]
    for vertex, sample in ((table.to_vertex[edges], last), (table.from_vertex[edges], first)):
        measured = data.accel_gyro[sample, 3:] - vi_map.vertices.gyro_bias[vertex]
        result[vertex] = np.einsum("nij,nj->ni", gyro_corrections, measured)
    return result
