"""All factors of a window that are not observations of landmarks."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from types import ModuleType

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.kernels import window as kernels
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE, DenseSystem
from maplab_py.estimation.window import inertial
from maplab_py.estimation.window.options import WindowOptions
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """Part of the factors: consecutive edges, and factors of single frames."""

    edges: slice
    frames: slice


EVERY = Part(slice(None), slice(None))


@dataclasses.dataclass(frozen=True, eq=False)
class FrameFactors:
    """Inertial edges, random walk of the biases, and factors of frames at rest."""

    chain: inertial.InertialChain
    standstill: Standstill
    is_resting: Mask  # (F,) frames surely without velocity
    is_turning: Mask  # (F,) frames that only turn, which is less sure

    @cached_property
    def _walk_weight(self) -> F64:  # once edges are integrated, it stays
        return self.chain.walk_weight

    @cached_property
    def _has_still(self) -> bool:
        return any(mask.any() for mask in (self.chain.is_resting, self.is_resting, self.is_turning))

    def costs(self, states: WindowStates) -> dict[str, float]:
        """Return half the sum of squares of every kind at some states."""
        residual, _ = self.chain.evaluate(states.T_M_I, states.motion, EVERY.edges)
        costs = {"inertial": 0.5 * float(np.vdot(residual, residual))}
        nothing = DenseSystem.zeros(0)
        weight = self._walk_weight
        costs["bias walk"] = float(kernels.add_walks(states.motion, weight, nothing))
        still = self._still(states, EVERY)
        if still:
            costs["standstill"] = sum(0.5 * float(np.vdot(r, r)) for r, _, _ in still)
        return costs

    def add_to(
        self, system: DenseSystem, states: WindowStates, at: WindowStates, part: Part = EVERY
    ) -> dict[str, float]:
        """Add the normal equations of some factors; return the costs.

        Residuals are those at `states`, Jacobians those at `at`.
        """
        edges = part.edges
        residual, jacobian = self.chain.evaluate(states.T_M_I, states.motion, edges)
        if at is not states:
            _, jacobian = self.chain.evaluate(at.T_M_I, at.motion, edges)
        rows = 15 * np.arange(len(self.chain), dtype=np.int64)[edges]
        costs = {"inertial": float(kernels.add_factors(residual, jacobian, rows, system))}
        weight = np.zeros((len(self.chain), 2))
        weight[edges] = self._walk_weight[edges]
        costs["bias walk"] = float(kernels.add_walks(states.motion, weight, system))
        still = self._still(states, part)
        if still:
            where = still if at is states else self._still(at, part)
            pairs = zip(still, where, strict=True)
            costs["standstill"] = sum(
                float(kernels.add_factors(r, np.ascontiguousarray(J), first, system))
                for (r, _, first), (_, J, _) in pairs
            )
        return costs

    def _still(self, states: WindowStates, part: Part) -> list[Factors]:
        """Return the factors of edges and frames at rest."""
        if not self._has_still:
            return []
        edges, frames = np.arange(len(self.chain))[part.edges], np.arange(len(states))[part.frames]
        resting = edges[self.chain.is_resting[edges]]
        still = frames[self.is_resting[frames] | self.is_turning[frames]]
        factors: list[Factors] = []
        if len(still):
            is_sure = self.is_resting[still]
            factors.append(self.standstill.velocities(still, ~is_sure, states.motion))
        if len(resting):
            factors.append(self.standstill.poses(resting, states.T_M_I))
        return factors


# Motion constraints without images: a body at rest does not move, one that only turns has no velocity.

Factors = tuple[F64, F64, I64]
"""Whitened residuals (N, m), Jacobians (N, m, D), and the rows (N,) where their columns begin."""

_POSE, _VELOCITY = 6, 6
"""Rows of a frame's pose, and where its velocity begins."""


class Standstill:
    """Factors of edges at rest: no change of pose, no velocity at both ends.

    With the inertial edge, zero velocity at both ends makes the mean measured acceleration that of
    gravity plus bias, and zero rotation makes the mean angular velocity the bias.
    """

    def __init__(self, kernel: ModuleType, options: WindowOptions) -> None:
        """Take the kernel of the residual `relative_pose`, and the deviations of a body at rest."""
        self._kernel, self._options = kernel, options
        weights = np.repeat([1.0 / options.rest_sigma_m, 1.0 / options.rest_sigma_rad], 3)
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
        options = self._options
        sigma = np.where(is_turning, options.turning_sigma_mps, options.rest_sigma_mps)
        jacobian = np.eye(3) / sigma[:, None, None]
        return motion[frames, :3] / sigma[:, None], jacobian, FRAME_SIZE * frames + _VELOCITY
