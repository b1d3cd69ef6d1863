"""Rejection of tracks that do not observe one point; all others then have their full weight.

A robust loss limits the influence of outliers, but its weights on good measurements are neither those
of the best estimate nor those that make its covariance right. Tracks that switched to another point
have a large sum of squared residuals. Without them, plain least squares yields both.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization.map_problem import MapProblem
from maplab_py.array_types import Mask
from maplab_py.estimation.states import States

_MIN_SHARE_LEFT = 2.0 / 3.0
"""Landmarks that keep a smaller share of their observations are rejected: the rest may be consistent
by accident."""
_NO_LOSS_SCALE = 1e3
"""Scale of a robust loss, in standard deviations, at which it has no effect."""


@dataclasses.dataclass(frozen=True)
class TrackTest:
    """Result of the chi-square test of tracks."""

    inconsistent: int = 0  # landmarks rejected
    noise_factor: float = 1.0  # measured keypoint noise over the map's


def reject_tracks_chi2(
    problem: MapProblem, states: States, probability: float, has_parallax: Mask | None = None
) -> TrackTest:
    """Reject landmarks with too large residuals; give the others full weight at the measured noise.

    Under the hypothesis that a landmark's n observations are of one point, the sum of their squared
    residuals is chi-square distributed with 2 n - 3 degrees of freedom, in units of the noise. The
    noise is not taken from the map. For the test it is estimated from the median over landmarks, for
    the weights from the sum over accepted landmarks, which the test biases by a known factor.

    Args:
        problem: The problem; its weights and its losses are replaced.
        states: Converged under a robust loss.
        probability: Of rejecting a good landmark.
        has_parallax: Landmarks (L,) with enough parallax, None = all; the others are rejected, too.
    """
    from scipy.stats import chi2

    visual, rejection = problem.problem.visual, problem.rejection
    if visual is None or rejection is None:
        return TrackTest()
    data = visual.observations
    owner, count = data.landmark, len(data.start) - 1
    squares = np.nan_to_num(visual.errors(states)[0] * data.inverse_sigma) ** 2
    total = np.bincount(owner, squares, minlength=count)
    if has_parallax is not None:
        inverse_sigma = np.where(has_parallax[owner], data.inverse_sigma, 0.0)
        data = dataclasses.replace(data, inverse_sigma=inverse_sigma)
    left = np.bincount(owner, data.inverse_sigma > 0.0, minlength=count)
    freedom = 2.0 * left - 3.0
    alive = np.flatnonzero(freedom > 0.0)
    whole = alive[left[alive] >= _MIN_SHARE_LEFT * np.diff(data.start)[alive]]
    if not len(whole):
        rejection.replace_weights(data)
        return TrackTest()
    variance = float(np.median(total[whole] / chi2.median(freedom[whole])))
    limit = chi2.isf(probability, freedom)
    kept = whole[total[whole] <= variance * limit[whole]]
    # mean of a chi-square below a limit: n F_{n+2}(limit) / F_n(limit)
    expected = freedom[kept] * chi2.cdf(limit[kept], freedom[kept] + 2.0) / (1.0 - probability)
    factor = float(np.sqrt(np.sum(total[kept]) / np.sum(expected)))
    is_kept = np.zeros(count, dtype=np.bool_)
    is_kept[kept] = True
    used = (data.inverse_sigma > 0.0) & is_kept[owner]
    rejection.replace_weights(
        dataclasses.replace(
            data,
            inverse_sigma=np.where(used, data.inverse_sigma / factor, 0.0),
            loss_scale=np.full(len(data), _NO_LOSS_SCALE),
        )
    )
    return TrackTest(len(alive) - len(kept), factor)
