"""The benchmarks live: on the small problem the costs are equal and nothing has become slow.

The bounds are generous, for machines that do other work meanwhile; docs/benchmarks.md has the
figures. Processor time is compared, since it suffers less from that.
"""

from __future__ import annotations

import pytest

from benchmarks.comparison import PEER, compare, scaling_exponent

PEER_MODULE = {"ceres": "pycolmap", "gtsam": "gtsam"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["visual", "inertial"])
def test_equal_cost_in_less_time_and_memory(kind: str) -> None:
    pytest.importorskip(PEER_MODULE[PEER[kind]], reason="a peer of the extra [bench] is not there")
    comparison = compare(kind, "small", repeats=2)
    assert abs(comparison.cost_difference) <= 1e-6
    assert comparison.cpu_ratio <= 0.8
    assert comparison.ratio("peak_growth_mb") <= 0.6


@pytest.mark.slow
def test_conjugate_gradients_against_those_of_ceres() -> None:
    pytest.importorskip("pycolmap", reason="a peer of the extra [bench] is not there")
    comparison = compare("sessions", "small", repeats=2)
    assert abs(comparison.cost_difference) <= 1e-5
    assert comparison.cpu_ratio <= 0.8
    assert comparison.ratio("peak_growth_mb") <= 0.8


def test_exponent_is_that_of_a_power_law() -> None:
    measured = [
        {"observations": n, "user_s": 4 * 2e-6 * n**1.1, "system_s": 0.0, "iterations": 4}
        for n in (1_000, 30_000, 2_000_000)
    ]
    assert scaling_exponent(measured) == pytest.approx(1.1)
