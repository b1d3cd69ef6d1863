"""Hints on quaternion orders and clocks of trajectories that other people wrote."""

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.evaluation import plausibility
from maplab_py.algorithms.evaluation.options import TrajectoryEvaluationOptions
from maplab_py.algorithms.evaluation.trajectory_evaluation import evaluate_trajectory
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.interop.trajectories import Trajectory
from tests.algorithms.evaluation.test_evaluation import make_truth, moved, walked_map

OPTIONS = TrajectoryEvaluationOptions()
ROWS = np.arange(0, 4000, 40)


def orientations(count: int = 60) -> np.ndarray:
    return make_truth(count * 40).T_R_B[::40, :4]


@pytest.mark.parametrize(
    ("misread", "name"),
    [
        (lambda q: np.roll(q, 1, axis=1), "qw first would"),
        (lambda q: np.roll(q, -1, axis=1), "qw last would"),
        (so3.inverse, "inverted rotations would"),
        (lambda q: np.roll(so3.inverse(q), 1, axis=1), "qw first and inverted"),
    ],
)
def test_wrong_orders_are_named_with_figures(misread: object, name: str) -> None:
    truth = make_truth()
    wrong = se3.make(misread(truth.T_R_B[:, :4]), truth.T_R_B[:, 4:])  # type: ignore[operator]
    report = evaluate_trajectory(
        walked_map(truth, ROWS), Trajectory(truth.times_ns, wrong, source="t"), OPTIONS
    )
    assert len(report.notes) == 1
    assert name in report.notes[0]
    assert "deg" in report.notes[0]
    assert report.notes[0][1:] in report.display().summary


def test_right_orders_and_mounted_bodies_get_no_hint() -> None:
    truth = make_truth()
    vi_map = moved(walked_map(truth, ROWS), np.random.default_rng(1).normal(size=(100, 3)) * 0.02)
    turn = se3.make(so3.exp([0.4, -1.2, 2.0]), np.zeros(3))
    for T in (truth.T_R_B, se3.compose(truth.T_R_B, turn)):
        report = evaluate_trajectory(vi_map, Trajectory(truth.times_ns, T, source="truth"), OPTIONS)
        assert report.notes == ()


def test_an_order_is_found_beside_a_constant_rotation() -> None:
    q = orientations()
    wrong = np.roll(so3.multiply(q, so3.exp([0.3, 2.0, 0.5])), 1, axis=1)
    assert "qw first would give" in plausibility.orientation_hint(wrong, q)
    assert "beside a constant rotation" in plausibility.orientation_hint(wrong, q)
    assert plausibility.orientation_hint(wrong, q, is_mounted=True) == ""


def test_motions_name_the_order_in_any_frame() -> None:
    q = orientations()
    other = so3.multiply(so3.exp([0.0, 0.0, 1.0]), q)
    apart_deg, hint = plausibility.motion_hint(np.roll(other, 1, axis=1), q)
    assert apart_deg > 10.0
    assert "qw first" in hint
    assert plausibility.motion_hint(other, q)[1] == ""


@pytest.mark.parametrize("offset_s", [0.35, -2.0])
@pytest.mark.parametrize("has_orientation", [True, False])
def test_a_shifted_clock_is_named(offset_s: float, has_orientation: bool) -> None:
    truth = make_truth()
    late = dataclasses.replace(
        truth,
        times_ns=truth.times_ns + round(offset_s * 1e9),
        has_orientation=has_orientation,
    )
    report = evaluate_trajectory(walked_map(truth, ROWS), late, OPTIONS)
    assert len(report.notes) == 1
    said = float(report.notes[0].split("--time_offset_s=")[1].split()[0])
    assert said == pytest.approx(-offset_s, abs=2e-3)
    right = dataclasses.replace(OPTIONS, time_offset_s=said)
    after = evaluate_trajectory(walked_map(truth, ROWS), late, right)
    assert after.notes == ()
    assert after.ape_m.rmse < 0.01


def test_a_clock_from_zero_is_named_in_the_refusal() -> None:
    truth = make_truth()
    boot = dataclasses.replace(truth, times_ns=truth.times_ns - truth.times_ns[0])
    with pytest.raises(EstimationError, match=r"--time_offset_s=1403715273\.26\d\d would"):
        evaluate_trajectory(walked_map(truth, ROWS), boot, OPTIONS)


def test_another_path_gets_no_clock() -> None:
    truth = make_truth()
    rng = np.random.default_rng(3)
    p = np.cumsum(rng.normal(size=(4000, 3)), axis=0) * 0.02
    q = so3.exp(np.cumsum(rng.normal(size=(4000, 3)), axis=0) * 0.01)
    other = Trajectory(truth.times_ns - 10**15, se3.make(q, p), source="other")
    with pytest.raises(EstimationError) as caught:
        evaluate_trajectory(walked_map(truth, ROWS), other, OPTIONS)
    assert "time_offset_s" not in str(caught.value)


def test_positions_alone_have_errors_of_position() -> None:
    truth = make_truth()
    T = se3.make(np.tile(so3.identity(), (len(truth), 1)), truth.T_R_B[:, 4:])
    positions = Trajectory(truth.times_ns, T, source="truth", has_orientation=False)
    report = evaluate_trajectory(walked_map(truth, ROWS), positions, OPTIONS)
    assert report.ape_m.rmse < 1e-9
    assert (report.ape_deg, report.rpe_deg, report.body_rotation_deg) == (None, None, None)
    assert "positions only" in report.display().summary
    assert [line.error for line in report.display().errors] == ["APE [m]", "APE, Sim(3) [m]"]


@pytest.mark.parametrize("seed", range(8))
def test_offsets_without_overlap_are_never_the_best(seed: int) -> None:
    """Correlations by FFT leave overlaps of 0 within rounding, positive or negative."""
    rng = np.random.default_rng(seed)
    truth = make_truth(1200 + 7 * seed)
    T = se3.make(truth.T_R_B[:, :4], truth.T_R_B[:, 4:] + rng.normal(size=(len(truth), 3)) * 1e-3)
    shift_ns = 250_000_000
    found = plausibility.clock_offset_ns(
        truth.times_ns - shift_ns,
        T,
        truth.times_ns,
        truth.T_R_B,
        lambda ns: abs(ns - shift_ns) * 1e-9,
    )
    assert found is not None
    assert abs(found[0] - shift_ns) < 1_000_000
