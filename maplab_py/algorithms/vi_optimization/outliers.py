"""Outlier rejection of observations: initial gate and tests while solving."""

import dataclasses

import numpy as np

from maplab_py.algorithms.vi_optimization.options import RobustnessOptions
from maplab_py.array_types import F64, Mask, NDArray
from maplab_py.distinct import distinct
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import Observations, VisualTerms

_MIN_OBSERVATIONS = 2
"""Minimum number of inliers of an active landmark."""
_OUTLYING = 3.0
"""Minimum error of an outlier in multiples of the median, for states far from the optimum."""
_USUAL_PX = 2.0
"""Error from which on observations count little where positions of a landmark are compared."""
_CLEARLY_LESS = 0.9
"""Share of the loss below which another position is taken: near the optimum both are the same but for
rounding, and a choice between them would differ from processor to processor."""


class OutlierRejection:
    """Deactivates outliers and activates them again when their error falls below the gate."""

    def __init__(self, visual: VisualTerms, sigma_px: F64, options: RobustnessOptions) -> None:
        """Activate all observations of landmarks with at least two."""
        self._visual, self._sigma_px, self._options = visual, sigma_px, options
        self.is_used: Mask = np.ones(len(sigma_px), dtype=np.bool_)
        self._passed_gate: Mask = self.is_used

    @property
    def gated(self) -> int:
        """Number of observations rejected before solving that are still inactive."""
        return int(np.count_nonzero(~self._passed_gate & ~self.is_used))

    @property
    def rejected(self) -> int:
        """Number of observations rejected while solving."""
        return int(np.count_nonzero(self._passed_gate & ~self.is_used))

    def gate(self, states: States) -> None:
        """Reject initial outliers: behind the camera or with an error above the gate."""
        self._reject(states, self._options.gate_reprojection_error_px)
        self._passed_gate = self.is_used

    def doubtful_landmarks(self) -> NDArray[np.int64]:
        """Return the landmarks with rejected observations."""
        data = self._visual.observations
        return distinct(data.landmark[~self.is_used])

    def restart(self) -> None:
        """Activate every observation again."""
        self.is_used = np.ones(len(self._sigma_px), dtype=np.bool_)
        self._visual.use(self._visual.observations.switched(self.is_used, self._sigma_px))

    def after_step(self, iteration: int, states: States) -> bool:
        """Test all observations every n iterations; return whether any was switched."""
        options = self._options
        if iteration % max(options.outlier_rejection_reject_every_n_iters, 1):
            return False
        changed = self._visual.refresh(states)
        if not options.use_visual_outlier_rejection_solver:
            return changed
        before = self.is_used
        self._reject(states, options.outlier_rejection_max_reprojection_error_px)
        return changed or bool(np.any(before != self.is_used))

    def replace_weights(self, observations: Observations) -> None:
        """Use observations with other weights; observations of weight zero are inactive."""
        self.is_used = observations.inverse_sigma > 0.0
        self._visual.use(observations)

    def used_landmarks(self) -> Mask:
        """Return which landmarks (L,) are active."""
        return self._used_per_landmark() >= _MIN_OBSERVATIONS

    def better_placed(self, states: States, others: States) -> States:
        """Return the states with each landmark at the position that its observations contradict less.

        Outliers count alike, so that an optimised landmark does not leave its inliers for them.
        """
        data, errors = self._visual.observations, []
        for candidate in (states, others):
            error_px, depth_m = self._visual.errors(candidate)
            ahead = (depth_m > 0.0) & np.isfinite(error_px)
            errors.append(np.where(ahead, error_px, np.inf))
        largest_px = self._options.outlier_rejection_max_reprojection_error_px
        largest_px = max(largest_px, _OUTLYING * float(np.median(errors[0])))
        loss = [np.log1p((np.minimum(e, largest_px) / _USUAL_PX) ** 2) for e in errors]
        now, new = (np.bincount(data.landmark, x, minlength=len(data.start) - 1) for x in loss)
        is_better = (new < _CLEARLY_LESS * now)[:, None]
        return dataclasses.replace(states, p_G=np.where(is_better, others.p_G, states.p_G))

    def _agree(self, states: States, max_error_px: float) -> Mask:
        """Return which observations lie in front of the camera with an error below the limit."""
        error_px, depth_m = self._visual.errors(states)
        # comparisons with NaN are false: a point that does not project is rejected
        ahead = (depth_m > 0.0) & np.isfinite(error_px)
        known = error_px[ahead & self.is_used]
        usual = float(np.median(known)) if len(known) else 0.0
        return np.asarray(ahead & (error_px <= max(max_error_px, _OUTLYING * usual)))

    def _reject(self, states: States, max_error_px: float) -> None:
        self.is_used = self._agree(states, max_error_px)
        alive = self.used_landmarks()
        self.is_used &= alive[self._visual.observations.landmark]
        self._visual.use(self._visual.observations.switched(self.is_used, self._sigma_px))

    def _used_per_landmark(self) -> NDArray[np.int64]:
        data = self._visual.observations
        return np.bincount(data.landmark, self.is_used, minlength=len(data.start) - 1).astype(
            np.int64
        )
