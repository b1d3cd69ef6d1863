"""Absolute pose of a camera rig from matches of keypoints with points, many queries at once.

Two matches and the gravity direction determine yaw and position (a quadratic), so that few samples
suffice even at a high outlier ratio. Every improved hypothesis is refined with all six degrees of
freedom (MSAC with local optimisation: Torr and Zisserman 2000, Chum et al. 2003).
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.geometry import se3, so3, symmetric


@dataclasses.dataclass(frozen=True, eq=False)
class PoseProblems:
    """Matches of many queries: those of query p are rows start[p] .. start[p + 1] - 1.

    Within a query, rows are sorted by keypoint; several points may compete for one keypoint.
    """

    start: I64  # (P + 1,)
    key: I64  # (P,) determines the random numbers of a problem, together with the seed
    q_M_I: F64  # (P, 4) attitude of the query in a gravity-aligned frame; its yaw does not matter
    origin_I: F64  # (N, 3) camera centres in the query's body frame [m]
    ray_I: F64  # (N, 3) unit rays of the keypoints in the body frame
    point_M: F64  # (N, 3) matched points in the gravity-aligned frame of the points [m]
    keypoint: I64  # (N,)
    tolerance: F64  # (N,) tangent of the largest angle between an inlier's ray and its point


@dataclasses.dataclass(frozen=True, eq=False)
class PoseSolutions:
    """Estimated poses; a query without solution has no inliers."""

    T_M_I: F64  # (P, 7)
    inlier_count: I64  # (P,) inlier keypoints
    keypoint_count: I64  # (P,) keypoints that had a match
    is_inlier: NDArray[np.bool_]  # (N,) one match at most per keypoint
    covariance: F64  # (P, 6, 6) of [dp, dtheta] in the convention of `se3`, NaN where undetermined
    tilt_rad: F64  # (P,) angle between the given and the estimated gravity


def solve_poses(
    problems: PoseProblems,
    *,
    seed: int = 0,
    max_iterations: int = 200,
    tilt_sigma_rad: float = 0.02,
) -> PoseSolutions:
    """Estimate the pose of every query. Deterministic in the seed, for any number of threads.

    Args:
        problems: The matches.
        seed: Seed of the random samples.
        max_iterations: Maximum number of samples per query; a high inlier ratio needs fewer.
        tilt_sigma_rad: Standard deviation of the given roll and pitch.
    """
    count, matches = len(problems.key), len(problems.keypoint)
    of_match = np.repeat(np.arange(count), np.diff(problems.start))
    q_W_I = problems.q_M_I  # W: the frame of the attitude, with its origin at the body
    solved = search_level(
        LevelProblems(
            start=problems.start,
            seed=mixed_seeds(problems.key, seed),
            origin_W=so3.rotate(q_W_I[of_match], problems.origin_I),
            ray_W=so3.rotate(q_W_I[of_match], problems.ray_I),
            point_M=np.ascontiguousarray(problems.point_M),
            keypoint=problems.keypoint,
            inverse_sigma=1.0 / problems.tolerance,
        ),
        max_iterations=max_iterations,
        tilt_sigma_rad=tilt_sigma_rad,
    )
    is_first = np.ones(matches, dtype=np.bool_)
    is_first[1:] = (of_match[1:] != of_match[:-1]) | (
        problems.keypoint[1:] != problems.keypoint[:-1]
    )
    keypoints = np.bincount(of_match[is_first], minlength=count)
    return PoseSolutions(
        T_M_I=solved.poses(q_W_I),
        inlier_count=solved.inlier_count,
        keypoint_count=keypoints,
        is_inlier=solved.is_inlier,
        covariance=solved.covariances(q_W_I),
        tilt_rad=solved.tilt_rad,
    )


class LevelProblems(NamedTuple):
    """PoseProblems with query data rotated to W, the level frame at the body, as kernels take them."""

    start: I64  # (P + 1,)
    seed: NDArray[np.uint64]  # (P,) see `mixed_seeds`
    origin_W: F64  # (N, 3)
    ray_W: F64  # (N, 3)
    point_M: F64  # (N, 3)
    keypoint: I64  # (N,)
    inverse_sigma: F64  # (N,) 1 / tolerance


class LevelSolutions(NamedTuple):
    """Estimated poses T_M_W, filled in by kernels; expensive quantities are computed on request."""

    R_M_W: F64  # (P, 3, 3)
    p_M_W: F64  # (P, 3)
    information: F64  # (P, 6, 6) of [dp, dtheta_W]
    cost: F64  # (P,)
    inlier_count: I64  # (P,) inlying keypoints
    is_inlier: NDArray[np.bool_]  # (N,)

    @property
    def tilt_rad(self) -> F64:
        """Angle (P,) between the given and the estimated gravity."""
        return np.asarray(np.arccos(np.clip(self.R_M_W[:, 2, 2], -1.0, 1.0)))

    def poses(self, q_W_I: F64) -> F64:
        """Return the poses T_M_I (P, 7)."""
        T_M_W = se3.make(so3.from_matrix(self.R_M_W), self.p_M_W)
        return se3.compose(T_M_W, se3.make(q_W_I, np.zeros((len(q_W_I), 3))))

    def covariances(self, q_W_I: F64) -> F64:
        """Return the covariances (P, 6, 6) of [dp, dtheta], NaN where undetermined."""
        return _covariances(self.information, q_W_I)


def search_level(
    problems: LevelProblems, *, max_iterations: int = 200, tilt_sigma_rad: float = 0.02
) -> LevelSolutions:
    """Estimate poses as `solve_poses` does, for queries already rotated to W."""
    from maplab_py.vision import pose_kernels

    count = len(problems.seed)
    poses = LevelSolutions(
        R_M_W=np.tile(np.eye(3), (count, 1, 1)),
        p_M_W=np.zeros((count, 3)),
        information=np.empty((count, 6, 6)),
        cost=np.empty(count),
        inlier_count=np.empty(count, dtype=np.int64),
        is_inlier=np.zeros(len(problems.keypoint), dtype=np.bool_),
    )
    settings = pose_kernels.SearchSettings(max_iterations, 1.0 / tilt_sigma_rad)
    pose_kernels.search_poses(problems, settings, poses)
    return poses


def _covariances(H: F64, q_W_I: F64) -> F64:
    """Invert the information (P, 6, 6) of [dp, dtheta_W] and turn dtheta to I."""
    H = 0.5 * (H + np.swapaxes(H, 1, 2))
    scale = np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-300))
    scaled = H / (scale[:, :, None] * scale[:, None, :])
    determined = symmetric.eigen(scaled)[0][:, 0] > 1e-10  # false where an entry is no number
    scaled = np.where(determined[:, None, None], scaled, np.eye(6))
    covariance = symmetric.inverse(scaled) / (scale[:, :, None] * scale[:, None, :])
    turn = np.zeros_like(H)
    turn[:, :3, :3] = np.eye(3)
    turn[:, 3:, 3:] = so3.to_matrix(so3.inverse(q_W_I))
    covariance = turn @ covariance @ np.swapaxes(turn, 1, 2)
    covariance[~determined] = np.nan
    return np.asarray(covariance)


def mixed_seeds(key: I64, seed: int) -> NDArray[np.uint64]:
    """Return a well-mixed random state for each problem's key (P,), by splitmix64's finaliser."""
    with np.errstate(over="ignore"):
        z = key.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(seed % 2**63)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return np.asarray(z ^ (z >> np.uint64(31)))


def compile_kernels() -> None:
    """Compile the search on one query."""
    points = 8
    point = np.random.default_rng(0).uniform(1.0, 5.0, (points, 3))
    problems = PoseProblems(
        start=np.array([0, points]),
        key=np.zeros(1, dtype=np.int64),
        q_M_I=so3.identity(1),
        origin_I=np.zeros((points, 3)),
        ray_I=point / np.linalg.norm(point, axis=1, keepdims=True),
        point_M=se3.transform(se3.identity(), point),
        keypoint=np.arange(points),
        tolerance=np.full(points, 0.01),
    )
    solve_poses(problems, max_iterations=2)
