"""Radius schedules and the acceptance of steps."""

from __future__ import annotations

import pytest

from maplab_py.estimation.problem.trust_region import Schedule, StepJudge, TrustRegion


def region(schedule: Schedule) -> TrustRegion:
    return TrustRegion(100.0, 1e-3, 1e4, schedule)


def test_the_schedule_of_ceres() -> None:
    it = region(Schedule.CERES)
    it.accept(1.0)
    assert it.radius == pytest.approx(300.0)  # 1 / max(1/3, 1 - 1)
    it.accept(0.5)
    assert it.radius == pytest.approx(300.0)  # 1 / (1 - 0)
    it.accept(0.25)
    assert it.radius == pytest.approx(300.0 / 1.125)
    before = it.radius
    for divisor in (2, 8, 64):  # 2, then 2 * 4, then 2 * 4 * 8
        it.reject()
        assert it.radius == pytest.approx(before / divisor)
    it.accept(0.5)
    it.reject()
    assert it.radius == pytest.approx(before / 128)  # begins again with 2


@pytest.mark.parametrize(
    ("gain", "factor"), [(0.95, 10.0), (1.0, 100.0), (1.05, 10.0), (1.5, 10.0)]
)
def test_steps_as_good_as_promised_widen_most(gain: float, factor: float) -> None:
    it = region(Schedule.STEP_QUALITY)
    for gain, factor in ((0.5, 1.0), (0.97, 1.0 / (1.0 - 0.94**3)), (0.99, 1.0 / (1.0 - 0.98**3))):
        before = it.radius
        it.accept(gain)
        assert it.radius == pytest.approx(min(factor, 3.0 if gain == 0.97 else 100.0) * before)
    before = it.radius
    it.reject()
    assert it.radius == pytest.approx(before / 2.0)


def test_a_perfect_step_widens_a_hundredfold() -> None:
    it = region(Schedule.STEP_QUALITY)
    it.accept(1.0)
    assert it.radius == pytest.approx(1e4)


@pytest.mark.parametrize("schedule", list(Schedule))
def test_the_radius_keeps_its_limits(schedule: Schedule) -> None:
    it = region(schedule)
    for _ in range(20):
        it.accept(1.0)
    assert it.radius == 1e4
    assert not it.is_exhausted
    while not it.is_exhausted:
        it.reject()
    assert it.radius < 1e-3


def test_descent_only() -> None:
    judge = StepJudge(10.0)
    assert judge.gain(9.0, 2.0) == pytest.approx(0.5)
    assert judge.gain(11.0, 2.0) == pytest.approx(-0.5)
    assert judge.gain(9.0, 0.0) == -1.0


def test_uphill_steps_count_from_the_reference() -> None:
    judge = StepJudge(10.0, max_uphill=2)
    assert judge.accept(4.0, 6.0)  # the least so far
    assert judge.gain(5.0, 1.0) == pytest.approx((10.0 - 5.0) / 7.0)
    assert not judge.accept(5.0, 1.0)
    assert judge.gain(6.0, 1.0) == pytest.approx((10.0 - 6.0) / 8.0)
    assert not judge.accept(6.0, 1.0)  # the second: the reference comes down to the highest, 6
    assert judge.gain(7.0, 1.0) < 0.0
    assert judge.gain(5.0, 1.0) == pytest.approx(1.0)


def test_a_changed_problem_begins_anew() -> None:
    judge = StepJudge(10.0, max_uphill=3)
    judge.accept(2.0, 8.0)
    judge.restart(50.0)
    assert judge.gain(60.0, 1.0) < 0.0
    assert judge.accept(49.0, 1.0)


def test_a_problem_known_better_shifts_all_costs() -> None:
    known, shifted = StepJudge(10.0, max_uphill=2), StepJudge(10.0, max_uphill=2)
    for judge in (known, shifted):
        judge.accept(4.0, 6.0)
        judge.accept(5.0, 1.0)
    shifted.shift(3.0)
    assert shifted.gain(9.0, 1.0) == pytest.approx(known.gain(6.0, 1.0))
    assert shifted.accept(6.5, 1.0)  # less than the least was, with the difference
