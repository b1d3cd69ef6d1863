"""Which observations take part: gates at the beginning, rejection while solving."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.estimation.states import F64, States
from maplab_py.estimation.visual_terms import VisualTerms

Mask = NDArray[np.bool_]

_MIN_OBSERVATIONS = 2
"""A landmark that keeps fewer does not take part."""


class OutlierRejection:
    """Switches observations off, never on again."""

    def __init__(self, visual: VisualTerms, sigma_px: F64, options: VIOptimizationOptions) -> None:
        """Begin with all observations of landmarks that have at least two."""
        self._visual, self._sigma_px, self._options = visual, sigma_px, options
        self.is_used: Mask = np.ones(len(sigma_px), dtype=np.bool_)
        self.gated = 0
        self.rejected = 0

    def gate(self, states: States) -> None:
        """Leave out what is hopeless: behind the camera or off by more than the gate."""
        self._reject(states, self._options.gate_reprojection_error_px)
        self.gated = int(np.count_nonzero(~self.is_used))

    def doubtful_landmarks(self) -> NDArray[np.int64]:
        """Return the landmarks that lost observations to the gate."""
        data = self._visual.observations
        return np.unique(data.landmark[~self.is_used])

    def restart(self) -> None:
        """Let every observation take part again."""
        self.is_used = np.ones(len(self._sigma_px), dtype=np.bool_)
        self._visual.use(self._visual.observations.switched(self.is_used, self._sigma_px))

    def after_step(self, iteration: int, states: States) -> bool:
        """Reject outliers every n iterations; tell whether there were any."""
        options = self._options
        every = max(options.outlier_rejection_reject_every_n_iters, 1)
        if not options.use_visual_outlier_rejection_solver or iteration % every:
            return False
        before = int(np.count_nonzero(self.is_used))
        self._reject(states, options.outlier_rejection_max_reprojection_error_px)
        rejected = before - int(np.count_nonzero(self.is_used))
        self.rejected += rejected
        return rejected > 0

    def used_landmarks(self) -> Mask:
        """Tell which landmarks (L,) take part."""
        return self._used_per_landmark() >= _MIN_OBSERVATIONS

    def _reject(self, states: States, max_error_px: float) -> None:
        error_px, depth_m = self._visual.reprojection(states.T_G_I, states.p_G)
        # comparisons with NaN are false: a point that does not project is rejected
        self.is_used = self.is_used & (error_px <= max_error_px) & (depth_m > 0.0)
        alive = self.used_landmarks()
        self.is_used &= alive[self._visual.observations.landmark]
        self._visual.use(self._visual.observations.switched(self.is_used, self._sigma_px))

    def _used_per_landmark(self) -> NDArray[np.int64]:
        data = self._visual.observations
        return np.bincount(data.landmark, self.is_used, minlength=len(data.start) - 1).astype(
            np.int64
        )
