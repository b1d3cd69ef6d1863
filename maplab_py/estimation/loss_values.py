"""Values of the robust losses for arrays of residuals."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels.loss import rho_and_weight_of_all
from maplab_py.estimation.loss import Loss


def loss_and_weight(loss: Loss, c2: F64 | float, s: F64) -> tuple[F64, F64]:
    """Return rho(s) and its derivative for squared whitened residuals (N,) and squared scales."""
    rho, weight = np.empty(len(s)), np.empty(len(s))
    scales = np.full(len(s), c2, dtype=np.float64)
    rho_and_weight_of_all(int(loss), np.ascontiguousarray(s), scales, rho, weight)
    return rho, weight
