"""Pose graphs as least squares: one node of six numbers per pose.

`Problem` has five nodes of three numbers per vertex. On graphs of some hundred poses these nodes and
the stored Jacobians cost several times as much as blocks of 6 x 6 (see decision 11). The
solver, the trust region and the losses are the same.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import block_cholesky, protocol
from maplab_py.estimation.linear.ordering import Ordering, OrderingKind
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.protocol import Step
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.terms.pose_graph import RelativePoses, TiltPriors

_SMALL_DAMPING = (1e-12, 1e-9, 1e-6)
"""Enough for parts of the graph that no active edge holds."""


_UNHELD = 1e-12
"""Share of the largest entry of the diagonal that a pose gets which no active edge holds."""


class EdgeWeights(NamedTuple):
    """Choice and weights of edges."""

    is_active: Mask  # (E,)
    first_robust: int  # edges from here on have the loss
    loss: int  # code, see `estimation.loss`
    scale2: float  # squared scale of the loss


class PoseSystem(NamedTuple):
    """Normal equations by 6 x 6 blocks: one block below the diagonal per edge, one per pose on it."""

    node: I64  # (E, 2) nodes of A and B, -1 where they are fixed
    below: I64  # (E,) row of `blocks`, -1 where an end is fixed
    blocks: F64  # (B, 6, 6)
    diagonal_block: F64  # (N, 6, 6) view of the diagonal blocks, of which lower triangles count
    gradient: F64  # (N, 6)
    diagonal: F64  # (N, 6) of the Gauss-Newton matrix


class TiltColumns(NamedTuple):
    """Arguments of the compiled loops: tilt priors."""

    vertex: I64  # (N,)
    node: I64  # (N,), -1 where the vertex is fixed
    q_G_I: F64  # (N, 4)
    weight: float  # 1 / sigma^2


@dataclasses.dataclass(frozen=True, eq=False)
class PoseLinearization:
    """The normal equations at some poses; the next ones of the same problem write into them."""

    system: PoseSystem
    cost: float

    @property
    def costs(self) -> dict[str, float]:
        """Half the sum of all rho."""
        return {"pose graph": self.cost}


class PoseGraphProblem:
    """Half of sum |trajectory|^2 + sum rho(|closure|^2) + sum |tilt|^2 over free poses (V, 7).

    A `protocol.LeastSquares` problem. The scale of the loss may change between solutions.
    """

    def __init__(
        self,
        is_free: Mask,
        trajectory: RelativePoses,
        closures: RelativePoses,
        tilt: TiltPriors,
        loss: Loss,
    ) -> None:
        """Analyse the structure of the normal equations."""
        self._closures, edges = closures, trajectory.followed_by(closures)
        self._kernels, self._edges = edges.kernels, edges.columns
        self._weights = EdgeWeights(np.ones(len(edges), np.bool_), len(trajectory), int(loss), 1.0)
        self._free = np.flatnonzero(is_free)
        size = len(self._free)
        node_of_vertex = np.full(len(is_free), -1, dtype=np.int64)
        node_of_vertex[self._free] = np.arange(size)
        self._tilt = TiltColumns(
            tilt.vertex,
            node_of_vertex[tilt.vertex],
            np.ascontiguousarray(tilt.q_G_I),
            1.0 / tilt.sigma_rad**2,
        )
        node = np.stack(
            [node_of_vertex[edges.from_vertex], node_of_vertex[edges.to_vertex]], axis=1
        )
        kept = np.flatnonzero(node.min(axis=1) >= 0)
        below = np.full(len(edges), -1, dtype=np.int64)
        below[kept] = np.arange(len(kept))
        blocks = np.zeros((len(kept) + size, 6, 6))
        self._system = PoseSystem(
            node, below, blocks, blocks[len(kept) :], np.zeros((size, 6)), np.zeros((size, 6))
        )
        self._diagonal = np.einsum("nii->ni", self._system.diagonal_block)  # a view
        nodes = np.arange(size)
        self._solver = block_cholesky.BlockCholesky(
            np.concatenate([node[kept].max(axis=1), nodes]),
            np.concatenate([node[kept].min(axis=1), nodes]),
            size,
            6,
            ordering=Ordering(OrderingKind.AUTO),
        )
        self._has_second_order = False
        self._linear: tuple[F64, PoseLinearization] | None = None

    def without_loss(self) -> PoseGraphProblem:
        """Return the same problem without a loss, which shares memory with this one."""
        other = copy.copy(self)
        is_active = self._weights.is_active.copy()
        other._linear = None
        other._weights = EdgeWeights(is_active, self._weights.first_robust, int(Loss.NONE), 1.0)
        return other

    def set_active(self, closures: Mask) -> None:
        """Use only some closures (L,)."""
        self._linear = None
        self._weights.is_active[self._weights.first_robust :] = closures

    def set_squared_scale(self, scale2: float) -> None:
        """Exchange the squared scale of the loss."""
        self._linear = None
        self._weights = self._weights._replace(scale2=scale2)

    @property
    def can_have_second_order(self) -> bool:
        """Whether residuals are logarithms without a loss."""
        return self._closures.error is PoseError.LOGARITHM and self._weights.loss == Loss.NONE

    @property
    def redundancy(self) -> int:
        """Measurements beyond what the poses need, all edges counted: the expected sum of squares."""
        return 6 * len(self._edges.first) + 2 * len(self._tilt.vertex) - 6 * len(self._free)

    def set_second_order(self, is_wanted: bool) -> None:
        """Add the second derivatives of residuals to the normal equations, or leave them out."""
        self._linear = None
        self._has_second_order = is_wanted

    def cost(self, T_G_I: F64) -> float:
        """Return the sum that is minimised, not halved, for poses (V, 7)."""
        tilt = self._kernels.add_tilt(T_G_I, self._tilt, self._system, False)
        return float(self._kernels.cost(T_G_I, self._edges, self._weights) + tilt)

    def relinearize(self, states: F64) -> bool:  # noqa: ARG002
        """Do nothing: no measurement depends on the states."""
        return False

    def linearize(self, states: F64, damping: float) -> PoseLinearization:  # noqa: ARG002
        """Form the normal equations, unless it is only the damping that has changed."""
        if self._linear is None or self._linear[0] is not states:
            self._linear = states, self._linearized(states)
        return self._linear[1]

    def _linearized(self, T_G_I: F64) -> PoseLinearization:
        system = self._system
        for array in (system.diagonal_block, system.gradient, system.diagonal):
            array.fill(0.0)
        total = self._kernels.normal_equations(T_G_I, self._edges, self._weights, system)
        total += self._kernels.add_tilt(T_G_I, self._tilt, system, True)
        if self._has_second_order:
            self._kernels.add_second_derivatives(T_G_I, self._edges, self._weights, system)
        return PoseLinearization(system, 0.5 * float(total))

    def try_step(self, states: F64, linear: PoseLinearization, damping: float) -> Step[F64]:
        """Return the poses after the damped step, or after a part of it if it leads uphill.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        gradient, added = linear.system.gradient, damping * _positive(linear.system.diagonal)
        self._factorise(added)
        twist = self._solver.solve(-gradient.reshape(-1)).reshape(-1, 6)
        downhill = -float(np.vdot(gradient, twist))
        curvature, share = downhill - float(np.vdot(twist, added * twist)), 1.0
        moved, cost = self._moved(states, twist)
        if linear.cost < cost < np.inf:
            # a shorter step, to the minimum of a parabola, takes less time than another factorisation
            share = 0.5 * downhill / (cost - linear.cost + downhill)
            twist *= share
            moved, cost = self._moved(states, twist)
        promised = share * (downhill - 0.5 * share * curvature)
        return Step(moved, {"pose graph": cost}, promised, float(np.sqrt(np.vdot(twist, twist))))

    def _moved(self, states: F64, twist: F64) -> tuple[F64, float]:
        """Return the poses after a step, and half the sum that is minimised there."""
        moved: F64 = self._kernels.moved(states, self._free, twist)
        return moved, 0.5 * self.cost(moved)

    def _factorise(self, added: F64) -> None:
        """Factorise the equations with some numbers (N, 6) added to their diagonal."""
        undamped = self._diagonal.copy()
        self._diagonal += added
        try:
            self._solver.factor(self._system.blocks)
        finally:
            self._diagonal[:] = undamped

    def is_stationary(self, linear: PoseLinearization, tolerance: float) -> bool:
        """Return whether no entry of the gradient is above a tolerance."""
        return bool(np.abs(linear.system.gradient).max(initial=0.0) <= tolerance)

    def norm(self, states: F64) -> float:
        """Return the norm of all values."""
        return float(np.sqrt(np.vdot(states, states)))

    def closure_uncertainty(self, T_G_I: F64) -> F64:
        """Return how uncertain closures' errors are by the poses alone: W J Sigma J^T W^T (L, 6, 6).

        With the identity added it is the covariance of the errors of closures that are left out;
        taken from the identity it is that of those which count.

        Raises:
            EstimationError: The poses are not determined.
        """
        self.set_second_order(False)
        linear = self.linearize(T_G_I, 0.0)
        for damping in _SMALL_DAMPING:
            with contextlib.suppress(protocol.NotPositiveDefinite):
                self._factorise(damping * _positive(linear.system.diagonal))
                break
        else:
            raise EstimationError("relaxation: the closures do not determine the poses")
        _, jacobian = self._closures.linearized(T_G_I)
        first = self._weights.first_robust
        node, below = self._system.node[first:], self._system.below[first:]
        num_below = len(self._system.blocks) - len(self._free)
        inverse = np.concatenate([self._solver.inverse_blocks(), np.zeros((1, 6, 6))])
        # the block of zeros where an end is fixed
        a, b = (inverse[np.where(node[:, k] >= 0, num_below + node[:, k], -1)] for k in range(2))
        ba = inverse[below]
        is_mirrored = node[:, 0] > node[:, 1]
        ba[is_mirrored] = np.swapaxes(ba[is_mirrored], 1, 2)
        J_A, J_B = jacobian[:, 0], jacobian[:, 1]
        cross = J_B @ ba @ np.swapaxes(J_A, 1, 2)
        variances = J_A @ a @ np.swapaxes(J_A, 1, 2) + J_B @ b @ np.swapaxes(J_B, 1, 2)
        return np.asarray(variances + cross + np.swapaxes(cross, 1, 2))


def _positive(diagonal: F64) -> F64:
    """Return a diagonal (N, 6) whose zeros are raised: no active edge holds these poses."""
    return np.asarray(np.maximum(diagonal, _UNHELD * diagonal.max(initial=1.0)))
