"""Gate of observations, weights by chi-square, thresholds between missions."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.data_selection import observations, select
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import LandmarkQuality, VIMap, edits
from tests.support.scene import Scene, corrupted

OPTIONS = VIOptimizationOptions()
TIGHT = dataclasses.replace(OPTIONS, function_tolerance=1e-9, num_iterations=40)
SCENE = Scene(vertices=10, landmarks=250, noise=1.0)


def with_outliers(vi_map: VIMap, every: int, offset_px: float) -> tuple[VIMap, np.ndarray]:
    """Shift every n-th observation in a direction of its own; return which keypoints."""
    bad = vi_map.observations[::every]
    angle = np.random.default_rng(3).uniform(0.0, 2.0 * np.pi, len(bad))
    uv = vi_map.keypoints.uv_px.copy()
    uv[bad] += offset_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv)), bad


def position_error(result: VIMap, truth: VIMap) -> float:
    return float(np.linalg.norm(result.T_G_I[:, 4:] - truth.T_G_I[:, 4:], axis=1).max())


@pytest.mark.parametrize("offset_px", [12.0, 250.0])
def test_outliers_do_no_harm_and_are_counted(offset_px: float) -> None:
    truth = SCENE.make()
    vi_map, bad = with_outliers(truth, 20, offset_px)
    without, _ = optimize(edits.remove_observations(truth, bad), TIGHT)
    result, report = optimize(vi_map, TIGHT)
    left_out = report.observations_not_used + report.observations_rejected
    assert left_out == len(bad)
    assert report.observations - left_out == next(
        term.count for term in report.terms if term.term == "reprojection"
    )
    assert position_error(result, without) <= 1e-4


def test_without_the_pass_outliers_stay() -> None:
    vi_map, bad = with_outliers(SCENE.make(), 20, 12.0)
    options = dataclasses.replace(OPTIONS, use_visual_outlier_rejection_solver=False)
    _, report = optimize(vi_map, options)
    assert report.observations_rejected == 0
    with_pass = optimize(vi_map, OPTIONS)[1]
    assert with_pass.observations_rejected >= 0.9 * len(bad)
    assert with_pass.cost_after < 0.8 * report.cost_after


@pytest.mark.parametrize("every", [1, 4])
def test_the_pass_comes_every_n_iterations(every: int) -> None:
    vi_map, bad = with_outliers(SCENE.make(), 20, 12.0)
    options = dataclasses.replace(
        OPTIONS,
        outlier_rejection_reject_every_n_iters=every,
        num_iterations=every - 1,
        function_tolerance=0.0,
    )
    assert optimize(vi_map, options)[1].observations_rejected == 0
    options = dataclasses.replace(options, num_iterations=every)
    assert optimize(vi_map, options)[1].observations_rejected >= 0.9 * len(bad)


def test_points_behind_the_camera_do_not_take_part() -> None:
    truth = SCENE.make()
    vertex = int(truth.landmarks.vertex[0])
    p_I = truth.landmarks.p_I.copy()
    p_I[0] *= -1.0
    behind = truth.replace(landmarks=truth.landmarks.replace(p_I=p_I))
    options = dataclasses.replace(OPTIONS, retriangulate_doubtful=False, num_iterations=1)
    result, report = optimize(behind, options)
    seen = int(np.count_nonzero(truth.keypoints.landmark == 0))
    assert report.observations_not_used == seen
    assert result.landmarks.quality[0] == LandmarkQuality.BAD
    np.testing.assert_array_equal(result.landmarks.p_I[0], p_I[0])
    assert result.landmarks.vertex[0] == vertex


def test_doubtful_landmarks_are_triangulated_anew() -> None:
    truth = SCENE.make()
    p_I = truth.landmarks.p_I.copy()
    p_I[::7] *= 3.0
    moved = truth.replace(landmarks=truth.landmarks.replace(p_I=p_I))
    result, report = optimize(moved, OPTIONS)
    clean, _ = optimize(truth, OPTIONS)
    assert report.observations_not_used == 0
    error = np.linalg.norm(result.landmarks.p_I - clean.landmarks.p_I, axis=1)[::7]
    is_bad = result.landmarks.quality[::7] == LandmarkQuality.BAD
    assert error[~is_bad].max() <= 0.01
    assert np.mean(is_bad) <= 0.2


def test_a_second_run_begins_where_the_first_has_ended() -> None:
    truth = SCENE.make()
    uv, landmark = truth.keypoints.uv_px.copy(), truth.keypoints.landmark
    for row in range(0, len(truth.landmarks), 10):  # tracks that have jumped
        of_track = np.flatnonzero(landmark == row)
        uv[of_track[-(2 * len(of_track) // 5) :], 0] += 25.0
    jumped = truth.replace(keypoints=truth.keypoints.replace(uv_px=uv))
    once, first = optimize(jumped, TIGHT)
    _, second = optimize(once, TIGHT)
    assert first.observations_rejected + first.observations_not_used > 0
    assert second.cost_before <= 1.001 * first.cost_after


def test_observations_return_when_poses_have_improved() -> None:
    truth = SCENE.make()
    rng = np.random.default_rng(1)
    far_off = corrupted(truth, rng, position_m=0.2, quaternion=0.05, landmark_m=0.2, keep=2)
    _, early = optimize(far_off, dataclasses.replace(OPTIONS, num_iterations=1))
    _, late = optimize(far_off, OPTIONS)
    assert early.observations_not_used > 0.01 * early.observations
    assert late.observations_not_used < 0.25 * early.observations_not_used
    assert late.mean_reprojection_after_px < 1.3


def test_landmark_left_with_one_observation_does_not_take_part() -> None:
    truth = SCENE.make()
    own = np.flatnonzero(truth.keypoints.landmark == 3)
    alone = edits.remove_observations(truth, own[1:])
    result, report = optimize(alone, OPTIONS)
    assert report.observations_not_used >= 1
    assert report.landmarks == len(truth.landmarks) - 1
    assert result.landmarks.quality[3] == LandmarkQuality.BAD


def test_landmarks_of_other_missions_have_their_own_threshold() -> None:
    vi_map = Scene(missions=2, vertices=5).make()
    options = dataclasses.replace(OPTIONS, loss_scale=1.5, loss_scale_other_mission=7.0)
    selection = select(vi_map, options, None)
    data, _ = observations(vi_map, selection, options, np.array([0, 1]))
    keypoints = selection.keypoints
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]
    home = vi_map.vertices.mission[vi_map.landmarks.vertex[vi_map.keypoints.landmark[keypoints]]]
    assert 0 < np.count_nonzero(mission != home) < len(keypoints)
    np.testing.assert_array_equal(data.loss_scale, np.where(mission == home, 1.5, 7.0))


NO_LOSS = VIOptimizationOptions(
    num_iterations=30,
    loss="none",
    use_visual_outlier_rejection_solver=False,
    gate_reprojection_error_px=1e9,
    function_tolerance=1e-9,
)
GAUGE = 4


def chi_square(vi_map: VIMap) -> tuple[float, int, dict[str, tuple[float, int]]]:
    """Return chi-square, degrees of freedom, and each term's part with its number of rows."""
    result, report = optimize(vi_map, NO_LOSS)
    rows = {"reprojection": 2, "inertial": 9, "bias walk": 6}
    parts = {t.term: (2.0 * t.cost_after, rows[t.term] * t.count) for t in report.terms}
    unknowns = 15 * len(result.vertices) + 3 * len(result.landmarks) - GAUGE
    return 2.0 * report.cost_after, sum(n for _, n in parts.values()) - unknowns, parts


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in range(2, 8))]
)
def test_visual_inertial(seed: int) -> None:
    scene = Scene(vertices=50, interval_s=0.25, landmarks=800, noise=1.0, seed=seed)
    total, freedom, _ = chi_square(scene.make())
    assert freedom > 5000  # one standard deviation is below 0.02
    assert 0.95 <= total / freedom <= 1.05
