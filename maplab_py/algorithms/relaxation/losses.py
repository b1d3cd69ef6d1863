"""Robust losses of squared normalised errors u, and the switch value that each one implies.

A loss replaces the cost u by rho(u); its derivative is the weight of the error in the normal
equations (iteratively reweighted least squares). All are quadratic near zero and know one number,
the price phi of switching off.

- none: rho = u.
- switchable: minimises s^2 u + phi (1 - s)^2 over the switch s in [0, 1], s = phi / (phi + u).
  Suenderhauf and Protzel, IROS 2012, with gamma = 1 and the linear switch function. Each switch
  belongs to one edge, so it is eliminated in closed form, without approximation.
- dcs: errors scaled by s = min(1, 2 phi / (phi + u)); Agarwal et al., ICRA 2013, eq. (15). The loss
  with that weight, rho' = s^2, is u up to phi, then phi (3 u - phi) / (u + phi).
- cauchy: phi log(1 + u / phi), which grows for ever, but slowly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation import relative_pose_kernels as kernels

F64 = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Loss:
    """A loss, compiled: `code` is its name in `estimation.relative_pose_kernels`."""

    code: int

    def __call__(self, u: F64, phi: float) -> tuple[F64, F64]:
        """Return rho and rho' of squared errors (E,) at a price."""
        rho, weight = kernels.losses(self.code, np.ascontiguousarray(u), phi)
        return rho, weight


LOSSES: dict[str, Loss] = {
    "none": Loss(kernels.QUADRATIC),
    "switchable": Loss(kernels.SWITCHABLE),
    "dcs": Loss(kernels.SCALED),
    "cauchy": Loss(kernels.CAUCHY),
}
