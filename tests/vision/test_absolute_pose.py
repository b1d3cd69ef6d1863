import dataclasses

import numba
import numpy as np
import pytest

from maplab_py.geometry import se3, so3
from maplab_py.vision.absolute_pose import solve_poses
from tests.vision.synthetic import pose_problems


def errors(found, truth):
    position = np.linalg.norm(found[:, 4:] - truth[:, 4:], axis=1)
    turn = so3.log(so3.multiply(so3.inverse(truth[:, :4]), found[:, :4]))
    return position, np.linalg.norm(turn, axis=1)


def test_exact_matches_give_the_exact_pose():
    problems, truth, _ = pose_problems(20, 30, outliers=0.0, noise_rad=0.0, tilt_rad=0.0, seed=1)
    found = solve_poses(problems)
    position, turn = errors(found.T_M_I, truth)
    assert position.max() < 1e-6
    assert turn.max() < 1e-6
    assert np.all(found.inlier_count == 30)


@pytest.mark.parametrize("outliers", [0.3, 0.6])
def test_pose_among_wrong_matches_with_noise_and_tilted_gravity(outliers):
    problems, truth, wrong = pose_problems(
        100, 80, outliers=outliers, noise_rad=0.001, tilt_rad=0.005, seed=2
    )
    found = solve_poses(problems)
    position, turn = errors(found.T_M_I, truth)
    assert position.max() < 0.05
    assert turn.max() < 0.01
    assert np.mean(wrong[found.is_inlier]) < 0.02
    assert found.is_inlier.sum() > 0.9 * np.count_nonzero(~wrong)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("flatness", [1.0, 0.0])
def test_pose_of_rigs_and_of_points_in_a_plane(flatness, cameras):
    problems, truth, wrong = pose_problems(
        40, 80, outliers=0.5, noise_rad=0.001, tilt_rad=0.005, seed=11,
        cameras=cameras, flatness=flatness,
    )  # fmt: skip
    found = solve_poses(problems, max_iterations=300)
    position, turn = errors(found.T_M_I, truth)
    assert position.max() < 0.05
    assert turn.max() < 0.01
    right = found.is_inlier & ~wrong
    assert right.sum() > 0.9 * np.count_nonzero(~wrong)


def test_covariance_matches_the_scatter():
    sigma = 0.001
    problems, truth, _ = pose_problems(400, 60, outliers=0.0, noise_rad=sigma, tilt_rad=0.0, seed=3)
    found = solve_poses(problems, tilt_sigma_rad=10.0)
    delta = se3.local(truth, found.T_M_I)
    # the tolerance stands for one standard deviation in the covariance
    scale = (sigma / problems.tolerance[0]) ** 2
    chi2 = np.einsum("ni,nij,nj->n", delta, np.linalg.inv(scale * found.covariance), delta)
    assert 5.0 < chi2.mean() < 7.5


def test_same_seed_same_bytes_on_any_number_of_threads():
    problems, _, _ = pose_problems(50, 60, outliers=0.7, noise_rad=0.001, tilt_rad=0.005, seed=4)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = solve_poses(problems, seed=5)
    finally:
        numba.set_num_threads(before)
    many = solve_poses(problems, seed=5)
    assert one.T_M_I.tobytes() == many.T_M_I.tobytes()
    assert one.is_inlier.tobytes() == many.is_inlier.tobytes()


def test_wrong_matches_alone_find_few_inliers():
    problems, _, _ = pose_problems(50, 80, outliers=1.0, noise_rad=0.001, tilt_rad=0.0, seed=6)
    assert solve_poses(problems).inlier_count.max() < 8


def test_keypoints_with_several_candidates_count_once():
    problems, truth, _ = pose_problems(10, 40, outliers=0.0, noise_rad=0.0, tilt_rad=0.0, seed=7)
    rng = np.random.default_rng(7)
    rows = np.repeat(np.arange(400), 2)
    point = problems.point_M[rows].copy()
    point[1::2] = rng.uniform(-6.0, 6.0, size=(400, 3))
    doubled = dataclasses.replace(
        problems,
        start=problems.start * 2,
        origin_I=problems.origin_I[rows],
        ray_I=problems.ray_I[rows],
        point_M=point,
        keypoint=problems.keypoint[rows],
        tolerance=problems.tolerance[rows],
    )
    found = solve_poses(doubled)
    assert errors(found.T_M_I, truth)[0].max() < 1e-6
    assert np.all(found.keypoint_count == 40)
    assert np.all(found.inlier_count == 40)
    assert found.is_inlier[0::2].all()


def test_two_matches_are_not_enough():
    problems, _, _ = pose_problems(5, 2, outliers=0.0, noise_rad=0.0, tilt_rad=0.0, seed=8)
    found = solve_poses(problems)
    assert np.all(found.inlier_count == 0)
    assert np.isnan(found.covariance).all()


def test_tilt_tells_how_far_gravity_was_off():
    problems, _, _ = pose_problems(20, 60, outliers=0.0, noise_rad=1e-3, tilt_rad=0.01, seed=9)
    found = solve_poses(problems)
    assert 0.005 < np.median(found.tilt_rad) < 0.02
