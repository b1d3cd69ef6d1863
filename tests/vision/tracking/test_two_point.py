"""Two-point RANSAC: outliers, turns on the spot, wrong and unknown turns."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64, Mask
from maplab_py.geometry import so3
from maplab_py.vision.tracking.motion import TwoPointLimits, TwoPointResult, two_point_motion

LIMITS = TwoPointLimits(
    threshold=np.deg2rad(0.5), gate=2.0 / 458.0, turn_sigma=5e-3, max_iterations=200
)
NOISE_RAD = 0.3 / 458.0


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    ray_C0: F64
    ray_C1: F64
    R_C1_C0: F64
    direction_C1: F64
    is_outlier: Mask


def make_pair(p_C0_C1: F64, outliers: int = 0, count: int = 120, seed: int = 0) -> Pair:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 8.0, count)
    point_C0 = (
        np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)), np.ones(count)]) * depth[:, None]
    )
    R_C0_C1 = so3.to_matrix(so3.exp(np.array([0.03, -0.05, 0.02])))
    point_C1 = (point_C0 - p_C0_C1) @ R_C0_C1
    rays = []
    for point in (point_C0, point_C1):
        ray = point / np.linalg.norm(point, axis=1, keepdims=True)
        ray += NOISE_RAD * rng.standard_normal(ray.shape)
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    is_outlier = np.arange(count) < outliers
    angle = rng.uniform(0.0, 2 * np.pi, outliers)
    moved = rays[1][:outliers] + 0.06 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    rays[1][:outliers] = moved / np.linalg.norm(moved, axis=1, keepdims=True)
    p_C1_C0 = -R_C0_C1.T @ p_C0_C1
    length = np.linalg.norm(p_C0_C1)
    return Pair(rays[0], rays[1], R_C0_C1.T, p_C1_C0 / length if length else p_C1_C0, is_outlier)


def left_of(motion: TwoPointResult, R_C1_C0: F64, pair: Pair) -> F64:
    """Return the error (3,) of a turn that the motion has corrected [rad]."""
    corrected = so3.to_matrix(so3.exp(motion.turn)) @ R_C1_C0
    return so3.log(so3.from_matrix(corrected @ pair.R_C1_C0.T))


@pytest.mark.parametrize("p_C0_C1", [[0.2, 0.0, 0.0], [0.05, -0.1, 0.3], [0.0, 0.02, -0.15]])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_outliers_are_separated_from_moved_points(p_C0_C1: list[float], seed: int) -> None:
    pair = make_pair(np.array(p_C0_C1), outliers=40, seed=seed)
    motion, _ = two_point_motion(pair.ray_C0, pair.ray_C1, pair.R_C1_C0, LIMITS, seed)
    assert np.mean(motion.is_inlier[~pair.is_outlier]) > 0.98
    # an outlier may happen to lie on its epipolar line
    assert np.mean(motion.is_inlier[pair.is_outlier]) < 0.15
    assert motion.direction @ pair.direction_C1 > np.cos(np.deg2rad(4.0))
    assert np.mean(motion.is_still) < 0.5


def test_a_turn_on_the_spot() -> None:
    pair = make_pair(np.zeros(3), outliers=30)
    motion, _ = two_point_motion(pair.ray_C0, pair.ray_C1, pair.R_C1_C0, LIMITS, 0)
    assert motion.is_still[~pair.is_outlier].all()
    assert motion.is_inlier[~pair.is_outlier].all()
    assert not motion.is_still[pair.is_outlier].any()
    assert np.mean(motion.is_inlier[pair.is_outlier]) < 0.15


def test_the_bias_of_a_gyroscope_is_taken_in() -> None:
    pair = make_pair(np.array([0.2, 0.05, 0.1]), outliers=30)
    error = np.array([2e-3, -3e-3, 2.5e-3])  # 0.09 rad/s over 50 ms
    wrong = so3.to_matrix(so3.exp(error)) @ pair.R_C1_C0
    motion, used = two_point_motion(pair.ray_C0, pair.ray_C1, wrong, LIMITS, 0)
    assert np.mean(motion.is_inlier[~pair.is_outlier]) > 0.97
    left = left_of(motion, wrong, pair)
    assert np.linalg.norm(left) < 0.25 * np.linalg.norm(error)
    assert np.array_equal(used, wrong)


@pytest.mark.parametrize("p_C0_C1", [[0.0, 0.0, 0.0], [0.15, 0.0, 0.1], [0.0, 0.1, 0.3]])
def test_an_unknown_turn_is_estimated(p_C0_C1: list[float]) -> None:
    pair = make_pair(np.array(p_C0_C1), outliers=30)
    motion, turn = two_point_motion(pair.ray_C0, pair.ray_C1, None, LIMITS, 0)
    error = left_of(motion, turn, pair)
    assert np.linalg.norm(error) < np.deg2rad(0.5)
    assert np.mean(motion.is_inlier[~pair.is_outlier]) > 0.9
    assert np.mean(motion.is_inlier[pair.is_outlier]) < 0.2


def test_points_behind_the_camera_are_outliers() -> None:
    pair = make_pair(np.array([0.3, 0.0, 0.0]))
    ray_C1 = pair.ray_C1.copy()
    # mirrored at the ray without parallax: the same epipolar planes, the other side
    still = pair.ray_C0 @ pair.R_C1_C0.T
    ray_C1[:20] = 2.0 * still[:20] - ray_C1[:20]
    ray_C1 /= np.linalg.norm(ray_C1, axis=1, keepdims=True)
    motion, _ = two_point_motion(pair.ray_C0, ray_C1, pair.R_C1_C0, LIMITS, 0)
    assert not motion.is_inlier[:20].any()
    assert motion.is_inlier[20:].mean() > 0.98


@pytest.mark.parametrize("count", [0, 1, 2, 3])
@pytest.mark.parametrize("knows_turn", [True, False])
def test_few_tracks(count: int, knows_turn: bool) -> None:
    pair = make_pair(np.zeros(3), count=count)
    given = pair.R_C1_C0 if knows_turn else None
    motion, _ = two_point_motion(pair.ray_C0, pair.ray_C1, given, LIMITS, 0)
    assert motion.is_inlier.shape == (count,)
    if knows_turn:
        assert motion.is_inlier.all()
    assert np.isfinite(motion.turn).all()
