"""The pose graph of a map: relative poses along the missions, and those of loop closures.

Residuals are split: the position part is in A, the angular part in B, W^T W = covariance^-1.
"""

import numpy as np

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.terms.pose_graph import RelativePoses
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.report import counted
from maplab_py.vimap import Backbone, LoopClosureEdges, TransformationKind, VIMap

_FLOOR_M_PER_SQRT_S = 0.005  # a standing device drifts too
_SHORTEST_S = 1e-3  # vertices without times, or with equal ones
_LOOP_FLOOR = np.repeat([0.03, np.deg2rad(0.5)], 3) ** 2


def trajectory_edges(vi_map: VIMap, options: RelaxationOptions) -> RelativePoses:
    """Return the edges between consecutive vertices: their present relative poses.

    Missions whose backbone is odometry keep what it measured, with its covariance, where they have
    it. Elsewhere the covariance has the shape of visual-inertial drift. Position errs by a random
    walk over the distance, heading by one over time; roll and pitch less, since gravity shows them.
    So the angular error is weighted in G's axes: W = diag(1/s_tilt, 1/s_tilt, 1/s_yaw) R_G_B.
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
    edges = RelativePoses(first, first + 1, T_A_B, W)
    return _with_odometry(vi_map, edges)


def has_odometry_backbone(vi_map: VIMap) -> Mask:
    """Tell of every vertex (V,) whether its mission hangs together by odometry, without an IMU."""
    is_odometry = vi_map.missions.backbone == Backbone.ODOMETRY
    return np.asarray(is_odometry[vi_map.vertices.mission])


def _with_odometry(vi_map: VIMap, edges: RelativePoses) -> RelativePoses:
    """Replace edges by those that odometry measured; wheels may have another scale."""
    odometry = vi_map.transformation_edges
    chosen = has_odometry_backbone(vi_map)[odometry.from_vertex]
    chosen &= odometry.to_vertex == odometry.from_vertex + 1
    chosen &= odometry.kind != TransformationKind.WHEEL_ODOMETRY
    covariance = _symmetric(odometry.covariance)
    chosen &= symmetric.is_positive_definite(covariance)
    rows = np.flatnonzero(chosen)
    edge_of_vertex = np.full(len(vi_map.vertices), -1, dtype=np.int64)
    edge_of_vertex[edges.from_vertex] = np.arange(len(edges))
    edge = edge_of_vertex[odometry.from_vertex[rows]]
    T_A_B, W = edges.T_A_B.copy(), edges.sqrt_information.copy()
    T_A_B[edge] = odometry.T_A_B[rows]
    W[edge] = symmetric.lower_whitening(covariance[rows])
    return RelativePoses(edges.from_vertex, edges.to_vertex, T_A_B, W)


def _symmetric(covariance: F64) -> F64:
    """Return symmetric matrices (N, 6, 6), zero where there is something that is no number."""
    result = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    result[~np.isfinite(result).all(axis=(1, 2))] = 0.0
    return np.asarray(result)


def loop_edges(
    edges: LoopClosureEdges,
    options: RelaxationOptions,
    *,
    as_given: Mask | None = None,
) -> RelativePoses:
    """Return loop closures as edges; those without a usable covariance get the options' one.

    Every covariance is widened by 3 cm and 0.5 deg: a registration knows nothing of the drift and
    the depth errors of the landmarks that it stands on (and maplab writes 1e-7 I).

    Args:
        edges: Loop closures (E).
        as_given: Edges (E,) whose covariance is not to be widened.
    """
    fallback = np.repeat([options.loop_sigma_m, np.deg2rad(options.loop_sigma_deg)], 3) ** 2
    covariance = _symmetric(np.array(edges.covariance))
    covariance[~symmetric.is_positive_definite(covariance)] = np.diag(fallback)
    widen = np.ones(len(edges)) if as_given is None else ~as_given * 1.0
    widened = covariance + widen[:, None, None] * np.diag(_LOOP_FLOOR)
    W = symmetric.lower_whitening(widened)
    return RelativePoses(
        edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64), edges.T_A_B, W
    )


def usable_loop_closures(
    vi_map: VIMap, edges: LoopClosureEdges, missions: I64 | None
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
        notes.append(
            f"{counted(int(np.count_nonzero(foreign)), 'closure')} left out: missions not chosen"
        )
    if np.any(itself):
        notes.append(
            f"{counted(int(np.count_nonzero(itself)), 'closure')} left out: a vertex with itself"
        )
    if np.any(floating):
        notes.append(
            f"{counted(int(np.count_nonzero(floating)), 'closure')} left out: missions of unknown base frame "
            "(anchor_all_missions or set_mission_baseframe_to_known makes them count)"
        )
    return edges.take(np.flatnonzero(~(foreign | itself | floating))), notes
