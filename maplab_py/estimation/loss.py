"""Robust losses of whitened residuals, and their scales."""

from enum import IntEnum


class Loss(IntEnum):
    """rho(s) of the squared whitened residual s with scale c; the codes are those of kernels."""

    NONE = 0  # s
    HUBER = 1  # s up to c^2, then 2 c sqrt(s) - c^2
    CAUCHY = 2  # c^2 log(1 + s / c^2)
    TUKEY = 3  # c^2 / 3 (1 - (1 - s / c^2)^3), constant from c^2 on
    GEMAN_MCCLURE = 4  # s c^2 / (c^2 + s)
    DCS = 5  # dynamic covariance scaling (Agarwal et al., ICRA 2013) with phi = c^2
