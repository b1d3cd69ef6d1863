"""Robust losses: which one, and how far a residual may go before it counts less."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class Loss(IntEnum):
    """rho(s) of the squared whitened residual s with scale c; codes as in the compiled kernels."""

    NONE = 0  # s
    HUBER = 1  # s up to c^2, then 2 c sqrt(s) - c^2
    CAUCHY = 2  # c^2 log(1 + s / c^2)
    TUKEY = 3  # c^2 / 3 (1 - (1 - s / c^2)^3), constant from c^2 on
    GEMAN_MCCLURE = 4  # s c^2 / (c^2 + s)
    DCS = 5  # dynamic covariance scaling (Agarwal et al., ICRA 2013) with phi = c^2


def robust(loss: Loss, c2: F64 | float, s: F64) -> tuple[F64, F64]:
    """Return rho(s) and its derivative for squared whitened residuals (N,) and squared scales."""
    if loss is Loss.HUBER:
        root = np.sqrt(c2 / np.maximum(s, c2))
        return np.where(s <= c2, s, 2.0 * s * root - c2), root
    if loss is Loss.CAUCHY:
        return c2 * np.log1p(s / c2), 1.0 / (1.0 + s / c2)
    if loss is Loss.TUKEY:
        t = np.maximum(1.0 - s / c2, 0.0)
        return c2 / 3.0 * (1.0 - t**3), t * t
    if loss is Loss.GEMAN_MCCLURE:
        t = c2 / (c2 + s)
        return s * t, t * t
    if loss is Loss.DCS:
        t = np.minimum(1.0, 2.0 * c2 / (c2 + s))
        return np.where(s <= c2, s, c2 * (3.0 * s - c2) / (s + c2)), t * t
    return s, np.ones_like(s)
