"""Motion constraints without images: a body at rest does not move, one that only turns has no velocity."""

from __future__ import annotations

import dataclasses
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.geometry import se3

Factors = tuple[F64, F64, I64]
"""Whitened residuals (N, m), Jacobians (N, m, D), and the rows (N,) where their columns begin."""

_POSE, _VELOCITY = 6, 6
"""Rows of a frame's pose, and where its velocity begins."""


@dataclasses.dataclass(frozen=True)
class StandstillSigmas:
    """Largest motion of a body at rest."""

    position_m: float  # over an edge
    rotation_rad: float
    velocity_mps: float
    turning_velocity_mps: float  # of a body that only turns


class Standstill:
    """Factors of edges at rest: no change of pose, no velocity at both ends.

    Together with the inertial edge, zero velocity at both ends says that the mean acceleration is
    zero against gravity and bias, and no turn that the mean angular velocity is the bias.
    """

    def __init__(self, kernel: ModuleType, sigmas: StandstillSigmas) -> None:
        """Take the kernel of the residual `relative_pose`."""
        self._kernel, self._sigmas = kernel, sigmas
        weights = np.repeat([1.0 / sigmas.position_m, 1.0 / sigmas.rotation_rad], 3)
        self._pose_weight = np.diag(weights)

    def poses(self, edges: I64, T_M_I: F64) -> Factors:
        """Return the factors of edges (N,): frame e + 1 is where frame e is."""
        count, still = len(edges), se3.identity(len(edges))
        arguments = np.concatenate([T_M_I[edges], T_M_I[edges + 1], still, still], axis=1)
        whitening = np.ascontiguousarray(np.broadcast_to(self._pose_weight, (count, 6, 6)))
        residual, jacobian = self._kernel.evaluated(arguments, whitening)
        wide = np.zeros((count, 6, FRAME_SIZE + _POSE))
        wide[:, :, :_POSE], wide[:, :, FRAME_SIZE:] = jacobian[:, :, :6], jacobian[:, :, 6:]
        return residual, wide, FRAME_SIZE * edges

    def velocities(self, frames: I64, is_turning: Mask, motion: F64) -> Factors:
        """Return the factors of frames (N,) without velocity; those that only turn are less sure."""
        sigmas = self._sigmas
        sigma = np.where(is_turning, sigmas.turning_velocity_mps, sigmas.velocity_mps)
        jacobian = np.eye(3) / sigma[:, None, None]
        return motion[frames, :3] / sigma[:, None], jacobian, FRAME_SIZE * frames + _VELOCITY
