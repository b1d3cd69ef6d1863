"""Robust losses of squared normalised errors u, and the switch value that each one implies.

A loss replaces the cost u by rho(u); its derivative is the weight of the error in the normal
equations (iteratively reweighted least squares). All are quadratic near zero and know one number,
the price phi of switching off.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Loss = Callable[[F64, float], tuple[F64, F64]]
"""(u, phi) -> rho(u), rho'(u)"""


def quadratic(u: F64, phi: float) -> tuple[F64, F64]:
    """Trust every error: rho = u."""
    del phi
    return u, np.ones_like(u)


def switchable(u: F64, phi: float) -> tuple[F64, F64]:
    """Minimise s^2 u + phi (1 - s)^2 over the switch s in [0, 1]: s = phi / (phi + u).

    Suenderhauf and Protzel, IROS 2012, with gamma = 1 and the linear switch function. Each switch
    belongs to one edge, so it is eliminated in closed form, without approximation.
    """
    s = phi / (phi + u)
    return s * u, s**2


def dynamic_covariance_scaling(u: F64, phi: float) -> tuple[F64, F64]:
    """Scale errors by s = min(1, 2 phi / (phi + u)); Agarwal et al., ICRA 2013, eq. (15).

    The loss with that weight, rho' = s^2, is u up to phi, then phi (3 u - phi) / (u + phi).
    """
    s = np.minimum(1.0, 2.0 * phi / (phi + u))
    return np.where(u <= phi, u, phi * (3.0 * u - phi) / (u + phi)), s**2


def cauchy(u: F64, phi: float) -> tuple[F64, F64]:
    """Return phi log(1 + u / phi), which grows for ever, but slowly."""
    return phi * np.log1p(u / phi), 1.0 / (1.0 + u / phi)


LOSSES: dict[str, Loss] = {
    "none": quadratic,
    "switchable": switchable,
    "dcs": dynamic_covariance_scaling,
    "cauchy": cauchy,
}
