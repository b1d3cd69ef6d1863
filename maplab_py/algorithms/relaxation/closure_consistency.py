"""Consistency of loop closures with a solution: errors measured against the graph's own accuracy.

The covariances of a graph are often off by a common factor. Adjustment theory estimates it from the
graph: the weighted sum of squares over the number of redundant measurements, the VARIANCE FACTOR (the
a posteriori variance of unit weight). Errors of closures that agree, divided by it, are chi-squared
with six degrees of freedom or, in real data, have a longer tail; those of false ones are larger by
orders of magnitude. In between there is a gap, and closures are told apart there.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.geometry import symmetric

_SMALLEST_FACTOR, _LARGEST_FACTOR = 1e-6, 4.0
_MEDIAN = 5.348  # of chi-squared with six degrees of freedom
_GIVEN = 50  # closures that weigh as much as the covariances as given
_NOTHING_ELSE = 1e-3
"""Redundancy below which other closures do not control one."""
_SELDOM = 0.01
_GAP = 2.0
"""Ratio of neighbouring squared errors that separates true from false ones."""
_TAIL = 0.25
"""Share of the closures below the limit that may be added as their tail."""
_WIDEST = 100.0
"""Times the limit: that far from it nothing is a tail."""


def variance_factor(u: F64) -> float:
    """Return the variance factor that independent errors of agreeing closures (E,) show.

    By their median, which some false ones among them change little. Few closures show little: the
    covariances as given count as much as fifty closures would, in terms of logarithms.
    """
    if len(u) == 0:
        return 1.0
    shown = max(float(np.median(u)) / _MEDIAN, 1e-300)
    factor = shown ** (len(u) / (len(u) + _GIVEN))
    return float(np.clip(factor, _SMALLEST_FACTOR, _LARGEST_FACTOR))


def independent_errors(error: F64, uncertainty: F64, counts: Mask) -> F64:
    """Return the squared normalised errors (E,) of closures against what all OTHERS say.

    A closure that counts pulls the solution and looks better than it is; one that does not count is
    measured against poses that are uncertain themselves. Both are put right by the covariance of the
    error (Baarda 1968, data snooping): I - P and I + P for the uncertainty P of the poses. The only
    closure that holds a part of the graph has nothing to be measured against, and no error.

    Args:
        error: Whitened errors (E, 6).
        uncertainty: P (E, 6, 6), whitened as well.
        counts: Which closures (E,) are part of the solution.
    """
    sign = np.where(counts, -1.0, 1.0)[:, None, None]
    covariance = np.eye(6) + sign * uncertainty
    value, vector = symmetric.eigen(covariance)
    along = np.einsum("eij,ei->ej", vector, error)
    return np.asarray(np.sum(along**2 / np.maximum(value, _NOTHING_ELSE), axis=1))


def largest_error(count: int) -> float:
    """Return what the largest of `count` squared errors of true closures exceeds once in a hundred graphs.

    Chi-squared with six degrees of freedom, without the longer tail of real data.
    """
    from scipy.special import chdtri

    return float(chdtri(6, _SELDOM / max(count, 1)))


def with_tail(u: F64, limit: float) -> Mask:
    """Tell which closures (E,) agree, if the errors of those which do have a longer tail.

    Up from the limit, those are added which follow closely upon one another. When they are too many
    for a tail there is no gap between true and false ones, and the limit itself decides.

    Args:
        u: Squared normalised errors.
        limit: Below it all agree.
    """
    above = np.sort(u[u > limit])
    step = np.append(above, np.inf) / np.append(limit, above)
    tail = int(np.argmax(step > _GAP))
    if tail == 0 or tail > _TAIL * np.count_nonzero(u <= limit):
        return np.asarray(u <= limit)
    return np.asarray(u <= min(above[tail - 1], _WIDEST * limit))
