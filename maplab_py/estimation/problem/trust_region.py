"""Trust region of the quadratic model: radius schedules, and acceptance of steps.

Damping is 1 / radius times the clamped diagonal of the normal equations (Levenberg-Marquardt).
"""

from enum import Enum

import numpy as np

from maplab_py.array_types import F64


class Schedule(Enum):
    """Schedule of the radius by the gain: actual over predicted decrease of the cost."""

    CERES = "ceres"  # radius / max(1/3, 1 - (2 gain - 1)^3); rejected: / 2, 4, 8 ...
    STEP_QUALITY = "step_quality"  # the same, but bolder after nearly perfect steps


_SMALLEST_DAMPED, _LARGEST_DAMPED = 1e-6, 1e32
_LARGEST_FACTOR = 100.0
_NEARLY_PERFECT = 0.02
"""A gain that misses one by less."""
_NEAR = 0.05
"""Relative decrease of the cost: of larger ones nothing can be said about convergence."""


def added_damping(diagonal: F64, damping: float) -> F64:
    """Return the damping of the diagonal of normal equations."""
    return np.asarray(damping * np.clip(diagonal, _SMALLEST_DAMPED, _LARGEST_DAMPED))


class TrustRegion:
    """The radius of one optimisation.

    CERES follows Madsen, Nielsen and Tingleff (Methods for Non-Linear Least Squares Problems, 2004,
    section 3.2) as Ceres does. STEP_QUALITY differs for steps whose decrease is within two percent of
    the prediction: they enlarge the radius by up to 100 instead of 3. Where the model is so accurate the
    radius only limits progress; half of the iterations are saved on clean maps, none are lost on others.
    """

    def __init__(
        self, initial: float, smallest: float, largest: float, schedule: Schedule = Schedule.CERES
    ) -> None:
        """Begin with a radius between the smallest and the largest."""
        self.radius = initial
        self._smallest, self._largest, self._schedule = smallest, largest, schedule
        self._shrink = 2.0

    @property
    def is_exhausted(self) -> bool:
        """Whether the radius fell below its limit."""
        return self.radius < self._smallest

    def accept(self, gain: float) -> None:
        """Adapt to a step that was taken."""
        factor = 1.0 / max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
        miss = abs(gain - 1.0)
        if self._schedule is Schedule.STEP_QUALITY and miss < _NEARLY_PERFECT:
            factor = min(_LARGEST_FACTOR, 1.0 / max(1e-9, 1.0 - (1.0 - 2.0 * miss) ** 3))
        self.radius = min(self.radius * factor, self._largest)
        self._shrink = 2.0

    def reject(self) -> None:
        """Adapt to a step that was not taken."""
        self.radius /= self._shrink
        self._shrink *= 2.0


class StepJudge:
    """Gains of steps, against the present cost and, if uphill steps are allowed, a past one.

    Non-monotone acceptance follows Conn, Gould and Toint (Trust-Region Methods, 2000, algorithm
    10.1.2): a step counts by the better of its gain over the present cost and its gain over a
    reference cost, set back to the highest since the last new minimum when `max_uphill` steps
    have gone without one.
    """

    def __init__(self, cost: float, max_uphill: int = 0) -> None:
        """Begin at a cost; max_uphill = 0 allows descent only."""
        self._max_uphill = max_uphill
        self.restart(cost)

    def restart(self, cost: float) -> None:
        """Begin again at a cost that cannot be compared with earlier ones."""
        self._cost = self._least = self._reference = self._highest = cost
        self._since_reference = self._since_highest = 0.0
        self._uphill = 0

    def gain(self, new_cost: float, promised: float) -> float:
        """Return the share of the promised decrease that a step brings."""
        if not promised > 0.0:
            return -1.0
        now = (self._cost - new_cost) / promised
        if self._max_uphill == 0:
            return now
        return max(now, (self._reference - new_cost) / (self._since_reference + promised))

    def accept(self, new_cost: float, promised: float) -> bool:
        """Accept a step; return whether its cost is the smallest so far."""
        self._cost = new_cost
        self._since_reference += promised
        self._since_highest += promised
        if new_cost < self._least:
            self._least = self._highest = new_cost
            self._uphill, self._since_highest = 0, 0.0
            return True
        self._uphill += 1
        if new_cost > self._highest:
            self._highest, self._since_highest = new_cost, 0.0
        if self._uphill >= self._max_uphill:
            self._reference, self._since_reference = self._highest, self._since_highest
        return False

    def shift(self, difference: float) -> None:
        """Add to all costs: the problem is the same, but known better."""
        self._cost += difference
        self._least += difference
        self._reference += difference
        self._highest += difference


class Decreases:
    """The last decreases of the cost, and a prediction of the next ones."""

    def __init__(self) -> None:
        self._previous = self._last = 0.0

    def add(self, decrease: float) -> None:
        """Take the decrease of an accepted step."""
        self._previous, self._last = self._last, decrease

    @property
    def ratio(self) -> float:
        """The last decrease over the one before; one half when there was none."""
        return min(self._last / self._previous, 0.999) if self._previous > 0.0 else 0.5

    @property
    def expected(self) -> float:
        """The sum of all that follow, as a geometric series; infinite after an uphill step."""
        if not self._last > 0.0:
            return np.inf
        return self._last * self.ratio / (1.0 - self.ratio)

    def is_slow(self, cost: float, slow_ratio: float) -> bool:
        """Return whether decreases that are small against the cost shrink by no more than a ratio."""
        is_near = 0.0 < self._last < _NEAR * cost
        return is_near and self._previous > 0.0 and self.ratio > slow_ratio
