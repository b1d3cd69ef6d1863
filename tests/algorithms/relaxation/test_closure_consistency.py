"""Which closures agree: independent errors, the graph's accuracy, tails and gaps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from maplab_py.algorithms.relaxation.robust import independent_errors, variance_factor, with_tail


@pytest.fixture(scope="module")
def adjustment():
    """Return 40 linear measurements (N, 6) of 30 unknowns, their whitened rows, and noise."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(40, 6, 30))
    return rows, rng.normal(size=(40, 6))


def _solved(rows, measured, counts):
    """Return errors and the uncertainty of the prediction, some measurements left out."""
    A = rows[counts].reshape(-1, 30)
    N = np.linalg.inv(A.T @ A)
    x = N @ A.T @ measured[counts].reshape(-1)
    return rows @ x - measured, rows @ N @ rows.transpose(0, 2, 1)


def test_errors_are_those_against_all_others(adjustment):
    rows, measured = adjustment
    everything = np.ones(40, dtype=np.bool_)
    with_all = independent_errors(*_solved(rows, measured, everything), everything)
    for row in range(5):
        others = everything.copy()
        others[row] = False
        without = independent_errors(*_solved(rows, measured, others), others)
        assert with_all[row] == pytest.approx(without[row], rel=1e-9)


def test_independent_errors_are_chi_squared(adjustment):
    rows, _ = adjustment
    counts = np.arange(40) % 3 > 0
    rng = np.random.default_rng(5)
    u = np.concatenate(
        [
            independent_errors(*_solved(rows, rng.normal(size=(40, 6)), counts), counts)
            for _ in range(50)
        ]
    )
    for share in (0.1, 0.5, 0.9, 0.99):
        assert np.quantile(u, share) == pytest.approx(chi2(6).ppf(share), rel=0.1)


def test_what_nothing_controls_has_no_error():
    u = independent_errors(np.full((1, 6), 1e-9), np.eye(6)[None], np.array([True]))
    assert u[0] < 1e-9


def test_variance_factor_is_that_of_the_noise_and_stays_within_reason():
    u = chi2(6).rvs(1000, random_state=1)
    assert variance_factor(u) == pytest.approx(1.0, rel=0.1)
    assert variance_factor(1e-3 * u) == pytest.approx(1e-3, rel=0.5)
    assert variance_factor(np.append(u, np.full(200, 1e9))) < 1.4
    assert variance_factor(1e3 * u) == 4.0
    assert variance_factor(1e-3 * u[:5]) > 0.5  # so few show little
    assert variance_factor(np.zeros(3)) > 0.0


def test_a_tail_is_kept_and_what_lies_beyond_the_gap_is_not():
    core = np.full(100, 5.0)
    u = np.concatenate([core, [25.0, 40.0, 70.0], [400.0, 420.0, 9e4]])
    assert with_tail(u, 20.0).tolist() == [True] * 103 + [False] * 3


def test_without_a_gap_the_limit_decides():
    core = np.full(20, 5.0)
    u = np.concatenate([core, np.geomspace(25.0, 1e4, 30)])
    np.testing.assert_array_equal(with_tail(u, 20.0), u <= 20.0)


def test_nothing_far_away_is_a_tail():
    u = np.concatenate([np.full(1000, 5.0), np.geomspace(21.0, 1e5, 40)])
    assert u[with_tail(u, 20.0)].max() <= 2000.0


def test_a_lone_error_is_judged_by_the_limit():
    assert with_tail(np.array([19.0]), 20.0).tolist() == [True]
    assert with_tail(np.array([21.0]), 20.0).tolist() == [False]
    assert with_tail(np.zeros(0), 20.0).tolist() == []
