"""Registration of two clouds by generalized ICP, and its information matrix.

Sources: Segal, Haehnel and Thrun, Generalized-ICP (RSS 2009); small_gicp (Koide, JOSS 2024) computes it.
Perturbations of poses are on the right, [dp, dtheta], both in the frame of the source.
"""

import dataclasses
from functools import cache
from typing import Any

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3, so3

_REMEDY = "pip install 'maplab-py[lidar]'"


@cache
def small_gicp() -> Any:
    """Return the library that registers clouds from initial poses.

    Raises:
        UserError: It is not installed.
    """
    try:
        import small_gicp as library
    except ImportError:
        raise UserError(f"registration of clouds needs the library small_gicp: {_REMEDY}") from None
    return library


@cache
def kiss_matcher() -> Any:
    """Return the library that registers clouds without initial poses.

    Raises:
        UserError: It is not installed.
    """
    try:
        import kiss_matcher as library
    except ImportError:
        raise UserError(f"--lidar_lc_global needs the library kiss_matcher: {_REMEDY}") from None
    return library


_MIN_POINTS = 100
"""Points that a thinned cloud needs."""
_COARSE = 4.0
"""Ratio of the voxels, and of the distances of corresponding points, of the first to the last pass."""
_FIRST_REACH = 8.0
_NEIGHBOURS, _COARSE_NEIGHBOURS = 20, 10
_ITERATIONS = 40
_MIN_COSINE = 0.5
"""Cosine between a normal and a direction from which on the point fixes the position along it."""


@dataclasses.dataclass(frozen=True, eq=False)
class PreparedCloud:
    """A thinned cloud with covariances and search trees, in two resolutions."""

    fine: Any
    fine_tree: Any
    coarse: Any
    coarse_tree: Any
    p_S: F64  # (N, 3) points of the fine resolution
    normal_S: F64  # (N, 3) unit normals of the surfaces


def prepare_cloud(p_S: F64, voxel_size_m: float, name: str) -> PreparedCloud:
    """Thin a cloud (N, 3), and compute its covariances and search trees.

    Raises:
        UserError: small_gicp is not installed.
        MapError: Too few points are left.
    """
    library = small_gicp()
    fine, tree = library.preprocess_points(p_S, voxel_size_m, _NEIGHBOURS, 1)
    coarse, coarse_tree = library.preprocess_points(
        p_S, _COARSE * voxel_size_m, _COARSE_NEIGHBOURS, 1
    )
    points = np.array(fine.points())[:, :3]
    if len(points) < _MIN_POINTS:
        raise MapError(
            f"{name} has {len(points)} points after thinning, registration needs {_MIN_POINTS}: choose "
            "a smaller --lidar_lc_voxel_size_m"
        )
    normals = np.asarray(np.linalg.eigh(np.array(fine.covs())[:, :3, :3])[1][:, :, 0])
    return PreparedCloud(fine, tree, coarse, coarse_tree, points, normals)


@dataclasses.dataclass(frozen=True, eq=False)
class Registration:
    """Pose of a source cloud in a target cloud."""

    T_T_S: F64  # (7,)
    residual_m: float  # root mean square distance of points from the other cloud's surface
    constraint: float  # share of points that fix the position along the worst direction
    information: F64  # (6, 6) of [dp, dtheta] for independent points
    correspondences: int


def register_clouds(
    target: PreparedCloud, source: PreparedCloud, T_T_S: F64, reach_m: float
) -> Registration:
    """Register a source cloud to a target cloud.

    Args:
        target: Cloud that stays.
        source: Cloud that moves.
        T_T_S: Initial pose (7,).
        reach_m: Largest distance of corresponding points in the last pass.
    """
    start = se3.to_matrix(T_T_S)
    arguments = {"registration_type": "GICP", "num_threads": 1, "max_iterations": _ITERATIONS}
    library = small_gicp()
    for reach in (_FIRST_REACH * reach_m, 0.5 * _FIRST_REACH * reach_m):
        coarse = library.align(
            target.coarse,
            source.coarse,
            target.coarse_tree,
            start,
            max_correspondence_distance=reach,
            **arguments,
        )
        start = coarse.T_target_source
    result = library.align(
        target.fine,
        source.fine,
        target.fine_tree,
        start,
        max_correspondence_distance=reach_m,
        **arguments,
    )
    pose = se3.from_matrix(np.array(result.T_target_source))
    return describe_fit(target, source, pose, reach_m)


def describe_fit(
    target: PreparedCloud, source: PreparedCloud, T_T_S: F64, reach_m: float
) -> Registration:
    """Return how well clouds fit at a pose (7,), by the distances of points from tangent planes.

    The Hessian of these distances is that of generalized ICP for exact planes; directions that only the
    points' own spacing fixes do not count.
    """
    p_T, nearest, near = correspondences(target, source, T_T_S, reach_m)
    rows = np.flatnonzero(near)
    normal_T = target.normal_S[nearest[rows]]
    distance = np.einsum("ni,ni->n", normal_T, p_T[rows] - target.p_S[nearest[rows]])
    R_S_T = so3.inverse(T_T_S[:4])
    normal_S = so3.rotate(R_S_T, normal_T)
    J = np.concatenate([normal_S, np.cross(source.p_S[rows], normal_S)], axis=1)
    H = J.T @ J
    residual_m = float(np.sqrt(np.mean(distance**2))) if len(rows) else np.inf
    return Registration(
        T_T_S, residual_m, _constraint(H, normal_S), H / max(residual_m, 1e-3) ** 2, len(rows)
    )


def correspondences(
    target: PreparedCloud, source: PreparedCloud, T_T_S: F64, reach_m: float
) -> tuple[F64, Any, Mask]:
    """Return the source's points in T (N, 3), the nearest target points (N,) and which are near (N,)."""
    p_T = se3.transform(T_T_S, source.p_S)
    index, squared = target.fine_tree.batch_nearest_neighbor_search(p_T, 1)
    return p_T, np.asarray(index).reshape(-1), np.asarray(squared).reshape(-1) <= reach_m**2


def _constraint(H: F64, normal: F64) -> float:
    """Return the share of points (N) that fix the position along its worst direction, for free rotation.

    Points whose normals (N, 3) are nearly perpendicular to it do not count: estimated normals err, and in
    a corridor those errors would seem to fix the position along its axis.
    """
    count = len(normal)
    if count < 6:
        return 0.0
    rotation = H[3:, 3:] + 1e-9 * count * np.eye(3)
    position = H[:3, :3] - H[:3, 3:] @ np.linalg.solve(rotation, H[3:, :3])
    along = normal @ np.linalg.eigh(position)[1][:, 0]
    return float(np.sum(along[np.abs(along) > _MIN_COSINE] ** 2)) / count
