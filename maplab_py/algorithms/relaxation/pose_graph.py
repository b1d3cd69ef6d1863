"""The pose graph of a map: relative poses along the missions, and those of loop closures.

Residual of an edge from vertex A to vertex B with measured T_A_B: e = [p_A_B - p_measured,
Log(R_measured^T R_A_B)], the position part in A, the angular part in B; W e with W^T W = covariance^-1.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vimap.tables import LoopClosureEdges

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FLOOR_M_PER_SQRT_S = 0.005  # a standing device drifts too
_SHORTEST_S = 1e-3  # vertices without times, or with equal ones
_LOOP_FLOOR = np.repeat([0.01, np.deg2rad(0.2)], 3) ** 2


@dataclasses.dataclass(frozen=True, eq=False)
class RelativePoses:
    """Measured relative poses between vertices (E edges)."""

    from_vertex: I64  # (E,) A
    to_vertex: I64  # (E,) B
    T_A_B: F64  # (E, 7)
    sqrt_information: F64  # (E, 6, 6) W, columns position, orientation

    def __len__(self) -> int:
        return len(self.from_vertex)

    def errors(self, T_G_I: F64) -> F64:
        """Return the whitened residuals W e (E, 6) for vertex poses (V, 7)."""
        T = se3.relative(T_G_I[self.from_vertex], T_G_I[self.to_vertex])
        angle = so3.log(so3.multiply(so3.inverse(self.T_A_B[:, :4]), T[:, :4]))
        error = np.concatenate([T[:, 4:] - self.T_A_B[:, 4:], angle], axis=1)
        return np.asarray(np.einsum("eij,ej->ei", self.sqrt_information, error))


def trajectory_edges(vi_map: VIMap, options: RelaxationOptions) -> RelativePoses:
    """Return the edges between consecutive vertices: their present relative poses.

    The covariance has the shape of visual-inertial drift. Position errs by a random walk over the
    distance, heading by one over time; roll and pitch hardly, since gravity shows them. So the
    angular error is weighted in G's axes: W = diag(1/s_tilt, 1/s_tilt, 1/s_yaw) R_G_B.
    """
    vertices = vi_map.vertices
    first = np.flatnonzero(np.diff(vertices.mission) == 0)
    A, B = vi_map.T_G_I[first], vi_map.T_G_I[first + 1]
    T_A_B = se3.relative(A, B)
    elapsed_s = (vertices.timestamp_ns[first + 1] - vertices.timestamp_ns[first]) * 1e-9
    root_s = np.sqrt(np.maximum(elapsed_s, _SHORTEST_S))
    distance_m = np.linalg.norm(T_A_B[:, 4:], axis=1)
    sigma_p = np.hypot(options.position_drift * np.sqrt(distance_m), _FLOOR_M_PER_SQRT_S * root_s)
    sigma_tilt = np.deg2rad(options.tilt_drift_deg) * root_s
    sigma_yaw = np.deg2rad(options.yaw_drift_deg) * root_s
    W = np.zeros((len(first), 6, 6))
    W[:, [0, 1, 2], [0, 1, 2]] = 1.0 / sigma_p[:, None]
    sigma_angle = np.stack([sigma_tilt, sigma_tilt, sigma_yaw], axis=1)
    W[:, 3:, 3:] = so3.to_matrix(B[:, :4]) / sigma_angle[:, :, None]
    return RelativePoses(first, first + 1, T_A_B, W)


def loop_edges(edges: LoopClosureEdges, options: RelaxationOptions) -> RelativePoses:
    """Return loop closures as edges; those without a usable covariance get the options' one.

    Every covariance is widened by 1 cm and 0.2 deg: what a registration claims of itself leaves
    out calibration and the landmarks' own drift, and maplab writes 1e-7 I.
    """
    fallback = np.repeat([options.loop_sigma_m, np.deg2rad(options.loop_sigma_deg)], 3) ** 2
    covariance = np.array(edges.covariance)
    symmetric = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    symmetric[~np.isfinite(symmetric).all(axis=(1, 2))] = 0.0
    positive = np.linalg.eigvalsh(symmetric).min(axis=1) > 0.0
    symmetric[~positive] = np.diag(fallback)
    widened = symmetric + np.diag(_LOOP_FLOOR)
    W = np.linalg.inv(np.linalg.cholesky(widened))  # covariance = L L^T, so L^-1 whitens
    return RelativePoses(
        edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64), edges.T_A_B, W
    )


def tilt_information(T_G_I: F64, sigma_deg: float) -> F64:
    """Return W (N, 6, 6) of priors that hold roll and pitch of poses (N, 7), and nothing else."""
    W = np.zeros((len(T_G_I), 6, 6))
    level = np.diag([1.0, 1.0, 0.0]) / np.deg2rad(sigma_deg)
    W[:, 3:, 3:] = level @ so3.to_matrix(T_G_I[:, :4])
    return W


def usable_loop_closures(
    vi_map: VIMap, edges: LoopClosureEdges, missions: NDArray[np.int64] | None
) -> tuple[LoopClosureEdges, list[str]]:
    """Leave out closures that cannot serve as constraints.

    Those are closures of missions that were not asked for; between a vertex and itself; and
    between missions of which one has an unknown base frame: its pose in G means nothing yet.

    Returns:
        The rest, and one sentence for each reason that occurred.
    """
    mission_of = vi_map.vertices.mission
    a, b = mission_of[edges.from_vertex], mission_of[edges.to_vertex]
    chosen = np.ones(len(vi_map.missions), dtype=np.bool_)
    if missions is not None:
        chosen[:] = False
        chosen[missions] = True
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    foreign = ~(chosen[a] & chosen[b])
    itself = ~foreign & (edges.from_vertex == edges.to_vertex)
    floating = ~foreign & (a != b) & ~(known[a] & known[b])
    notes = []
    if np.any(foreign):
        notes.append(f"{np.count_nonzero(foreign)} closures belong to missions not chosen")
    if np.any(itself):
        notes.append(f"{np.count_nonzero(itself)} closures join a vertex with itself")
    if np.any(floating):
        notes.append(
            f"{np.count_nonzero(floating)} closures lead to missions of unknown base frame "
            "(anchor_all_missions or set_mission_baseframe_to_known makes them count)"
        )
    return edges.take(np.flatnonzero(~(foreign | itself | floating))), notes


def clusters(num_vertices: int, edges: list[RelativePoses]) -> I64:
    """Return a label (V,) per vertex: vertices joined by edges have the same one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a = np.concatenate([e.from_vertex for e in edges])
    b = np.concatenate([e.to_vertex for e in edges])
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(num_vertices, num_vertices))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
