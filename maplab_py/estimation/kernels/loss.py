"""The losses of `estimation.loss`, compiled."""

import math

import numpy as np

from maplab_py.array_types import F64
from maplab_py.compilation import compiled
from maplab_py.estimation.loss import Loss

_HUBER, _CAUCHY, _TUKEY, _GEMAN_MCCLURE, _DCS = (int(loss) for loss in list(Loss)[1:])
_SMALL = 1e-2
"""Below, 1 + x loses digits that the slower log1p(x) keeps."""


@compiled(fastmath={"contract", "nsz"}, forceinline=True)
def rho_and_weight(kind: int, s: float, c2: float) -> tuple[float, float]:
    """Return rho(s) and its derivative for a squared whitened residual and a squared scale."""
    if kind == _HUBER:
        if s <= c2:
            return s, 1.0
        root = math.sqrt(c2 / s)
        return 2.0 * s * root - c2, root
    if kind == _CAUCHY:
        x = s / c2
        return c2 * (math.log(1.0 + x) if x > _SMALL else math.log1p(x)), 1.0 / (1.0 + x)
    if kind == _TUKEY:
        if s >= c2:
            return c2 / 3.0, 0.0
        x = s / c2
        return s * (1.0 - x + x * x / 3.0), (1.0 - x) * (1.0 - x)
    if kind == _GEMAN_MCCLURE:
        t = c2 / (c2 + s)
        return s * t, t * t
    if kind == _DCS:
        if s <= c2:
            return s, 1.0
        t = 2.0 * c2 / (c2 + s)
        return c2 * (3.0 * s - c2) / (s + c2), t * t
    return s, 1.0


@compiled()
def rho_and_weight_of_all(kind: int, s: F64, c2: F64, rho: F64, weight: F64) -> None:
    """Fill in rho (N,) and weight (N,) for squared residuals (N,) and squared scales (N,)."""
    for n in range(len(s)):
        rho[n], weight[n] = rho_and_weight(kind, s[n], c2[n])


def loss_and_weight(loss: Loss, c2: F64 | float, s: F64) -> tuple[F64, F64]:
    """Return rho(s) and its derivative for squared whitened residuals (N,) and squared scales."""
    rho, weight = np.empty(len(s)), np.empty(len(s))
    scales = np.full(len(s), c2, dtype=np.float64)
    rho_and_weight_of_all(int(loss), np.ascontiguousarray(s), scales, rho, weight)
    return rho, weight
