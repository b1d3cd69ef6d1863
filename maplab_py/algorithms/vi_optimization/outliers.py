"""Which observations take part: gates at the beginning, rejection while solving."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.estimation.states import F64, States
from maplab_py.estimation.visual_terms import VisualTerms

Mask = NDArray[np.bool_]

_MIN_OBSERVATIONS = 2
"""A landmark that keeps fewer does not take part."""
_OUTLYING = 3.0
"""An error of fewer medians is no outlier, however large: the states are still far off."""


class OutlierRejection:
    """Switches observations off, and on again where better states show that they were right."""

    def __init__(self, visual: VisualTerms, sigma_px: F64, options: VIOptimizationOptions) -> None:
        """Begin with all observations of landmarks that have at least two."""
        self._visual, self._sigma_px, self._options = visual, sigma_px, options
        self.is_used: Mask = np.ones(len(sigma_px), dtype=np.bool_)
        self._passed_gate: Mask = self.is_used

    @property
    def gated(self) -> int:
        """How many observations were left out from the beginning to now."""
        return int(np.count_nonzero(~self._passed_gate & ~self.is_used))

    @property
    def rejected(self) -> int:
        """How many observations that took part at the beginning do no more."""
        return int(np.count_nonzero(self._passed_gate & ~self.is_used))

    def gate(self, states: States) -> None:
        """Leave out what is hopeless: behind the camera or off by more than the gate."""
        self._reject(states, self._options.gate_reprojection_error_px)
        self._passed_gate = self.is_used

    def doubtful_landmarks(self) -> NDArray[np.int64]:
        """Return the landmarks that lost observations to the gate."""
        data = self._visual.observations
        return np.unique(data.landmark[~self.is_used])

    def restart(self) -> None:
        """Let every observation take part again."""
        self.is_used = np.ones(len(self._sigma_px), dtype=np.bool_)
        self._visual.use(self._visual.observations.switched(self.is_used, self._sigma_px))

    def after_step(self, iteration: int, states: States) -> bool:
        """Judge all observations anew every n iterations; tell whether anything has changed."""
        options = self._options
        if iteration % max(options.outlier_rejection_reject_every_n_iters, 1):
            return False
        changed = self._visual.refresh(states)
        if not options.use_visual_outlier_rejection_solver:
            return changed
        before = self.is_used
        self._reject(states, options.outlier_rejection_max_reprojection_error_px)
        return changed or bool(np.any(before != self.is_used))

    def used_landmarks(self) -> Mask:
        """Tell which landmarks (L,) take part."""
        return self._used_per_landmark() >= _MIN_OBSERVATIONS

    def better_placed(self, states: States, others: States) -> States:
        """Return the states with every landmark where more of its observations pass the gate."""
        data, limit = self._visual.observations, self._options.gate_reprojection_error_px
        passing = [
            np.bincount(data.landmark, self._agree(s, limit), minlength=len(data.start) - 1)
            for s in (states, others)
        ]
        is_better = (passing[1] > passing[0])[:, None]
        return dataclasses.replace(states, p_G=np.where(is_better, others.p_G, states.p_G))

    def _agree(self, states: States, max_error_px: float) -> Mask:
        """Tell which observations lie in front of the camera and are not too far off."""
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
