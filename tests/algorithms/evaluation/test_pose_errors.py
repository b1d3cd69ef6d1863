"""APE and RPE against evo's numbers, and their definitions on made-up paths."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.evaluation import pose_errors
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.interop.trajectories import read_trajectory
from tests.algorithms.evaluation import golden_evo
from tests.support.association import associate
from tests.support.data import shared_data

FILES = {
    "euroc": ("V102_groundtruth.csv", "V102.txt"),
    "tum": ("freiburg1_xyz-groundtruth.txt", "freiburg1_xyz-rgbdslam.txt"),
}


def matched(name: str) -> tuple[np.ndarray, np.ndarray]:
    truth, estimate = (
        read_trajectory(shared_data(f"trajectories/{f}"), keep_repeated=True) for f in FILES[name]
    )
    i, j = associate(truth.times_ns, estimate.times_ns, 10_000_000, one_to_one=False)
    return truth.T_R_B[i], estimate.T_R_B[j]


def check(errors: np.ndarray, golden: tuple[float, ...]) -> None:
    s = pose_errors.statistics(errors)
    assert s.count == golden[6]
    assert [s.rmse, s.mean, s.median, s.std, s.min, s.max] == pytest.approx(
        golden[:6], abs=1e-9, rel=0.0
    )


@pytest.mark.parametrize("name", list(FILES))
@pytest.mark.parametrize("alignment", ["none", "se3", "sim3"])
def test_ape_is_evos(name: str, alignment: str) -> None:
    truth, estimate = matched(name)
    aligned, scale = pose_errors.align(truth, estimate, alignment)
    metres, degrees = pose_errors.absolute_errors(truth, aligned)
    check(metres, golden_evo.ERRORS[name, "ape", alignment, "trans"])
    check(degrees, golden_evo.ERRORS[name, "ape", alignment, "rot"])
    expected = golden_evo.SCALE[name] if alignment == "sim3" else 1.0
    assert scale == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("name", list(FILES))
@pytest.mark.parametrize(
    ("unit", "delta"), [("frames", 1), ("frames", 10), ("meters", 1.0), ("meters", 0.1)]
)
@pytest.mark.parametrize("all_pairs", [True, False])
def test_rpe_is_evos(name: str, unit: str, delta: float, all_pairs: bool) -> None:
    truth, estimate = matched(name)
    aligned, _ = pose_errors.align(truth, estimate, "se3")
    if unit == "frames":
        pairs = pose_errors.pairs_by_frames(len(truth), int(delta), all_pairs=all_pairs)
    else:
        steps = np.linalg.norm(np.diff(aligned[:, 4:], axis=0), axis=1)
        pairs = pose_errors.pairs_by_length(steps, delta, all_pairs=all_pairs)
    metres, degrees = pose_errors.relative_errors(truth, aligned, pairs)
    key = (name, "rpe", unit, str(delta), "all" if all_pairs else "seq")
    check(metres, golden_evo.ERRORS[(*key, "trans")])
    check(degrees, golden_evo.ERRORS[(*key, "rot")])


def test_errors_of_a_moved_copy_vanish_after_alignment() -> None:
    rng = np.random.default_rng(4)
    truth = se3.make(so3.exp(rng.normal(size=(30, 3))), rng.normal(size=(30, 3)))
    turn = se3.make(so3.exp([0.0, 0.0, 2.0]), [3.0, -1.0, 0.5])
    moved = se3.compose(turn, truth)
    for alignment in ("se3", "sim3", "yaw"):
        aligned, scale = pose_errors.align(truth, moved, alignment)
        metres, degrees = pose_errors.absolute_errors(truth, aligned)
        assert np.max(metres) < 1e-13
        assert np.max(degrees) < 1e-11
        assert scale == pytest.approx(1.0)
    pairs = pose_errors.pairs_by_frames(30, 3, all_pairs=True)
    assert np.max(pose_errors.relative_errors(truth, moved, pairs)[0]) < 1e-13
    with pytest.raises(EstimationError, match="not one of se3, sim3, yaw, none"):
        pose_errors.align(truth, moved, "afine")


def brute_force_pairs(steps: np.ndarray, delta: float) -> list[list[int]]:
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    pairs = []
    for i in range(len(steps)):
        difference = np.abs(travelled[i + 1 :] - travelled[i] - delta)
        best = int(np.argmin(difference))
        if difference[best] <= 0.1 * delta:
            pairs.append([i, i + 1 + best])
    return pairs


@pytest.mark.parametrize("seed", range(20))
def test_all_pairs_are_those_of_an_exhaustive_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.exponential(0.3, 60) * (rng.random(60) > 0.3)
    pairs = pose_errors.pairs_by_length(steps, 1.0, all_pairs=True)
    assert pairs.tolist() == brute_force_pairs(steps, 1.0)


def test_consecutive_pieces_do_not_overlap() -> None:
    pairs = pose_errors.pairs_by_length(np.full(10, 0.25), 0.5, all_pairs=False)
    assert pairs.tolist() == [[0, 2], [2, 4], [4, 6], [6, 8], [8, 10]]
    assert pose_errors.pairs_by_length(np.full(3, 0.1), 5.0, all_pairs=False).shape == (0, 2)
    assert pose_errors.pairs_by_length(np.full(3, 0.1), 5.0, all_pairs=True).shape == (0, 2)
    assert pose_errors.pairs_by_length(np.zeros(0), 5.0, all_pairs=True).shape == (0, 2)
    assert pose_errors.pairs_by_frames(5, 2, all_pairs=False).tolist() == [[0, 2], [2, 4]]
    assert pose_errors.pairs_by_frames(4, 2, all_pairs=True).tolist() == [[0, 2], [1, 3]]


def test_pieces_without_length_are_refused() -> None:
    with pytest.raises(EstimationError, match="at least one frame"):
        pose_errors.pairs_by_frames(5, 0, all_pairs=True)
    with pytest.raises(EstimationError, match="must be positive"):
        pose_errors.pairs_by_length(np.ones(3), 0.0, all_pairs=True)


def test_mean_rotation_ignores_signs() -> None:
    rng = np.random.default_rng(0)
    centre = so3.exp([0.3, -2.0, 1.0])
    q = so3.multiply(centre, so3.exp(rng.normal(size=(200, 3)) * 0.01))
    q[::3] *= -1.0
    mean = pose_errors.mean_rotation(q)
    assert np.linalg.norm(so3.log(so3.multiply(so3.inverse(centre), mean))) < 0.003
