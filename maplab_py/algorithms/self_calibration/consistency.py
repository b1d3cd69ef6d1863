"""Which tracks are of one point: the others are left out, and the rest counts in full.

A robust loss bends around outliers but does not know how certain the result is: the weights that it
gives to good measurements are neither those that make the estimate best nor those that make its
covariance right. Tracks that jumped to another point betray themselves by their sum of squares.
Once they are gone, plain least squares do both.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.building import PosedProblem
from maplab_py.estimation.states import States

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_LEFT = 2.0 / 3.0
"""A landmark that keeps a smaller share of its observations is not one point: what is left of it may
fit by accident."""
_PLAIN = 1e3
"""Scale of a robust loss, in standard deviations, beyond which nothing is left of it."""


@dataclasses.dataclass(frozen=True)
class Consistency:
    """What was found."""

    landmarks: int
    inconsistent: int
    noise_factor: float  # keypoint noise over what the map says


def keep_consistent(
    posed: PosedProblem, states: States, probability: float, is_wide: Mask | None = None
) -> Consistency:
    """Leave out landmarks with too large residuals; weigh the others in full, by their true noise.

    Under the hypothesis that a landmark's n observations are of one point, the sum of their squared
    residuals is chi-square distributed with 2 n - 3 degrees of freedom, in units of the noise. The
    noise is not taken from the map: for the test it comes from the landmarks' medians, for the
    weights from the sum over those that pass, which the test has made smaller by a known factor.

    Args:
        posed: The problem; its weights and its losses are exchanged.
        states: Converged under a robust loss.
        probability: Of leaving out a good landmark.
        is_wide: Landmarks (L,) with enough parallax, None = all; the others are left out, too.
    """
    from scipy.stats import chi2

    visual, rejection = posed.problem.visual, posed.rejection
    if visual is None or rejection is None:
        return Consistency(0, 0, 1.0)
    data = visual.observations
    owner, count = data.landmark, len(data.start) - 1
    squares = np.nan_to_num(visual.errors(states)[0] * data.inverse_sigma) ** 2
    total = np.bincount(owner, squares, minlength=count)
    if is_wide is not None:
        data = dataclasses.replace(
            data, inverse_sigma=np.where(is_wide[owner], data.inverse_sigma, 0.0)
        )
    left = np.bincount(owner, data.inverse_sigma > 0.0, minlength=count)
    freedom = 2.0 * left - 3.0
    alive = np.flatnonzero(freedom > 0.0)
    whole = alive[left[alive] >= _LEAST_LEFT * np.diff(data.start)[alive]]
    if not len(whole):
        rejection.is_used = data.inverse_sigma > 0.0
        visual.use(data)
        return Consistency(len(alive), 0, 1.0)
    variance = float(np.median(total[whole] / chi2.median(freedom[whole])))
    limit = chi2.isf(probability, freedom)
    kept = whole[total[whole] <= variance * limit[whole]]
    # mean of a chi-square below a limit: n F_{n+2}(limit) / F_n(limit)
    expected = freedom[kept] * chi2.cdf(limit[kept], freedom[kept] + 2.0) / (1.0 - probability)
    factor = float(np.sqrt(np.sum(total[kept]) / np.sum(expected)))
    fits = np.zeros(count, dtype=np.bool_)
    fits[kept] = True
    used = (data.inverse_sigma > 0.0) & fits[owner]
    rejection.is_used = used
    visual.use(
        dataclasses.replace(
            data,
            inverse_sigma=np.where(used, data.inverse_sigma / factor, 0.0),
            loss_scale=np.full(len(data), _PLAIN),
        )
    )
    return Consistency(len(alive), len(alive) - len(kept), factor)
