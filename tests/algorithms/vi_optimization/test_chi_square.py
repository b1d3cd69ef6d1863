"""Weights are right: chi-square at the optimum is one per degree of freedom."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.vimap import VIMap
from tests.support.scene import Scene

OPTIONS = VIOptimizationOptions(
    num_iterations=30,
    loss="none",
    use_visual_outlier_rejection_solver=False,
    gate_reprojection_error_px=1e9,
    function_tolerance=1e-9,
)
GAUGE = 4


def chi_square(vi_map: VIMap) -> tuple[float, int, dict[str, tuple[float, int]]]:
    """Return chi-square, degrees of freedom, and each term's part with its number of rows."""
    result, report = optimize(vi_map, OPTIONS)
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


@pytest.mark.parametrize("seed", [1, 2])
def test_inertial_terms_by_themselves_at_the_truth(seed: int) -> None:
    """The trapezoid of shared samples has 1 - 1 / 2n of the variance of n independent steps."""
    scene = Scene(vertices=400, interval_s=0.2, landmarks=3, noise=1.0, seed=seed)
    options = VIOptimizationOptions(include_visual=False, num_iterations=0)
    _, report = optimize(scene.make(), options)
    parts = {term.term: (2.0 * term.cost_before, term.count) for term in report.terms}
    assert parts["bias walk"][0] / (6 * parts["bias walk"][1]) == pytest.approx(1.0, abs=0.06)
    assert parts["inertial"][0] / (9 * parts["inertial"][1]) == pytest.approx(1.0, abs=0.06)


def test_weights_that_are_wrong_show() -> None:
    vi_map = Scene(vertices=20, landmarks=400, noise=1.0).make()
    keypoints = vi_map.keypoints
    wrong = keypoints.replace(sigma_px=2.0 * np.asarray(keypoints.sigma_px))
    total, freedom, _ = chi_square(vi_map.replace(keypoints=wrong))
    assert total / freedom < 0.5
