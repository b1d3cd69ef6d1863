"""The uncertainty of a calibration: its parts, the deviations that are reported, and verdicts."""

from __future__ import annotations

import dataclasses
from enum import Enum

import numpy as np

from maplab_py.array_types import F64

MAX_PRIOR_SHARE = 0.5
"""Parameters that keep more of the prior's variance are left at the prior: the data say less."""
_WELL_DETERMINED_SHARE = 0.01
_MAX_SPREAD = 2.0
"""Parts of the data disagree where their spread is more than this many deviations."""


class Verdict(Enum):
    """Meaning of a parameter's deviation; values are the texts of reports."""

    WELL_DETERMINED = "well determined"
    WEAKLY_DETERMINED = "weakly determined"
    PARTS_DISAGREE = "weakly determined: parts of the data disagree by {:.1f} sigma"
    NOT_EXCITED = "not excited, left at its prior"
    KEPT = "kept: the data would move the camera by {:.0f} mm"

    def text(self, value: float = 0.0) -> str:
        """Return the text of reports."""
        return self.value.format(value)


@dataclasses.dataclass(frozen=True, eq=False)
class Uncertainty:
    """The uncertainty of k parameters.

    Every part allows for errors that those before it exclude. The reported deviation of a parameter
    is the largest of all parts.
    """

    prior_sigma: F64  # (k,)
    formal: F64  # (k, k): all measurements are independent, with the noise that was measured
    cluster_robust: F64 | None = None  # (k, k): errors may be correlated within a track
    spread: F64 | None = None  # (k,): standard error of the mean of results on parts of the data
    noise_factor: float = 1.0  # measured keypoint noise over the map's; `formal` contains it

    @property
    def formal_sigma(self) -> F64:
        """Formal deviations (k,)."""
        return np.sqrt(np.maximum(np.diag(self.formal), 1e-300))

    @property
    def cluster_robust_sigma(self) -> F64:
        """Deviations (k,) with tracks as clusters; the formal ones where they are not known."""
        if self.cluster_robust is None:
            return self.formal_sigma
        return np.sqrt(np.diag(self.cluster_robust))

    @property
    def model_sigma(self) -> F64:
        """Deviations (k,) that follow from the noise of the measurements."""
        return np.maximum(self.formal_sigma, self.cluster_robust_sigma)

    @property
    def sigma(self) -> F64:
        """Reported deviations (k,)."""
        return (
            self.model_sigma if self.spread is None else np.maximum(self.model_sigma, self.spread)
        )

    @property
    def track_factor(self) -> float:
        """Median ratio of cluster-robust to formal deviations."""
        return float(np.median(self.cluster_robust_sigma / self.formal_sigma))

    @property
    def prior_share(self) -> F64:
        """Share (k,) of the prior's variance that the data leave."""
        return np.asarray((self.formal_sigma / self.prior_sigma) ** 2)

    def covariance(self, formal_scale: float = 1.0) -> F64:
        """Return the smallest covariance (k, k) that is as large as both parts in every direction.

        Args:
            formal_scale: Factor of the formal covariance.
        """
        formal = self.formal * formal_scale
        if self.cluster_robust is None:
            return np.asarray(formal)
        return larger_covariance(formal, self.cluster_robust)

    def verdicts(self) -> tuple[str, ...]:
        """Return the text of the verdict on every parameter."""
        texts = []
        for share in self.prior_share:
            verdict = Verdict.WEAKLY_DETERMINED
            if share > MAX_PRIOR_SHARE:
                verdict = Verdict.NOT_EXCITED
            elif share < _WELL_DETERMINED_SHARE:
                verdict = Verdict.WELL_DETERMINED
            texts.append(verdict.text())
        if self.spread is not None:
            ratio = self.spread / self.model_sigma
            for k in np.flatnonzero(ratio > _MAX_SPREAD).tolist():
                texts[k] = Verdict.PARTS_DISAGREE.text(ratio[k])
        return tuple(texts)


def larger_covariance(first: F64, second: F64) -> F64:
    """Return the smallest covariance (k, k) that is as large as two others in every direction.

    Args:
        first: (k, k), positive definite.
        second: (k, k), of the same quantities.
    """
    L = np.linalg.cholesky(first)
    inverse = np.linalg.inv(L)
    share, turn = np.linalg.eigh(inverse @ second @ inverse.T)
    root = L @ turn
    return np.asarray((root * np.maximum(share, 1.0)) @ root.T)
