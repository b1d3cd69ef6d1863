"""Levenberg-Marquardt on a pose graph, edges as whole columns, normal equations by block Cholesky."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation.losses import Loss
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.relative_pose_kernels import normal_blocks
from maplab_py.geometry import se3, so3
from maplab_py.progress import Progress

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FIRST_DAMPING = 1e-8
_LARGEST_DAMPING = 1e8
_SUFFICIENT_DECREASE = 1e-7  # relative; less is convergence


@dataclasses.dataclass(frozen=True, eq=False)
class _Linearization:
    cost: float
    gradient: F64  # (N * 6,) of half the cost, by free pose
    blocks: F64  # (B, 6, 6) of the normal equations, one per entry of the structure


class PoseGraphOptimizer:
    """Minimises sum |trajectory|^2 + sum rho(|closure|^2) + sum |tilt|^2 over free poses."""

    def __init__(
        self,
        is_free: NDArray[np.bool_],
        trajectory: RelativePoses,
        loops: RelativePoses,
        tilt: TiltPriors,
        loss: Loss,
    ) -> None:
        """Prepare the structure of the normal equations."""
        self._edges = RelativePoses.concatenate(trajectory, loops)
        self._num_trajectory = len(trajectory)
        self._tilt = tilt
        self._loss = loss
        self._free = np.flatnonzero(is_free)
        variable = np.full(len(is_free), -1, dtype=np.int64)
        variable[self._free] = np.arange(len(self._free))
        self._a = variable[self._edges.from_vertex]
        self._b = variable[self._edges.to_vertex]
        self._t = variable[tilt.vertex]
        # each contribution is a block of its own: the solver adds those of equal place; the last
        # ones are the damping of the diagonal
        a, b, nodes = self._a, self._b, np.arange(len(self._free))
        places = [(a, a), (b, b), (np.maximum(a, b), np.minimum(a, b)), (self._t, self._t)]
        wanted = [col >= 0 for _, col in places]
        rows = [row[kept] for (row, _), kept in zip(places, wanted, strict=True)]
        cols = [col[kept] for (_, col), kept in zip(places, wanted, strict=True)]
        self._slot = np.full((len(a), 3), -1, dtype=np.int64)
        first = 0
        for part in range(3):
            count = int(np.count_nonzero(wanted[part]))
            self._slot[wanted[part], part] = first + np.arange(count)
            first += count
        turned = wanted[2] & (a > b)
        self._slot[turned, 2] = -2 - self._slot[turned, 2]
        self._num_edge_blocks = first
        self._tilt_kept = np.flatnonzero(wanted[3])
        size = len(self._free)
        self._blocks = np.zeros((first + len(self._tilt_kept) + size, 6, 6))
        self._solver = BlockCholesky(
            np.concatenate([*rows, nodes]), np.concatenate([*cols, nodes]), size, 6
        )

    def cost(self, T_G_I: F64, price: float) -> float:
        """Return the sum that is minimised, for poses (V, 7)."""
        u = self._edges.squared_errors(T_G_I)
        robust = self._loss(u[self._num_trajectory :], price)[0]
        tilt = np.sum(self._tilt.errors(T_G_I) ** 2)
        return float(np.sum(u[: self._num_trajectory]) + np.sum(robust) + tilt)

    def run(
        self, T_G_I: F64, price: float, max_iterations: int, progress: Progress
    ) -> tuple[F64, int]:
        """Iterate from poses (V, 7); return the new ones and the number of iterations.

        Raises:
            EstimationError: The poses are not determined, or not finite.
        """
        damping = _FIRST_DAMPING
        for iteration in range(max_iterations):
            progress.check()
            linear = self._linearize(T_G_I, price)
            if not np.isfinite(linear.cost):
                raise EstimationError("relaxation: the cost of the pose graph is not finite")
            accepted = None
            while accepted is None and damping < _LARGEST_DAMPING:
                candidate = self._step(T_G_I, linear, damping)
                cost = np.inf if candidate is None else self.cost(candidate, price)
                if cost < linear.cost:
                    accepted = candidate
                    damping = max(0.2 * damping, 1e-12)
                elif candidate is not None and linear.cost - cost > -1e-12 * linear.cost:
                    return T_G_I, iteration  # at the bottom, up to rounding
                else:
                    damping *= 10.0
            if accepted is None:
                return T_G_I, iteration
            T_G_I = accepted
            progress.line(f"  relax {iteration + 1:3d}  cost {cost:12.6g}  price {price:10.4g}")
            if linear.cost - cost <= _SUFFICIENT_DECREASE * linear.cost:
                return T_G_I, iteration + 1
        return T_G_I, max_iterations

    def _linearize(self, T_G_I: F64, price: float) -> _Linearization:
        error, J_a, J_b = self._edges.linearized(T_G_I)
        u = np.einsum("ei,ei->e", error, error)
        rho, weight = u.copy(), np.ones(len(u))
        closures = slice(self._num_trajectory, None)
        rho[closures], weight[closures] = self._loss(u[closures], price)
        blocks = self._blocks
        gradient, diagonal = np.zeros((2, len(self._free), 6))
        normal_blocks(
            error, J_a, J_b, weight, self._slot, self._a, self._b, blocks, gradient, diagonal
        )
        tilt_error, J_t = self._tilt.linearized(T_G_I)
        tilt_error_kept, J_t = tilt_error[self._tilt_kept], J_t[self._tilt_kept]
        tilt_blocks, tilt_node = np.swapaxes(J_t, 1, 2) @ J_t, self._t[self._tilt_kept]
        np.add.at(gradient, tilt_node, np.einsum("eij,ei->ej", J_t, tilt_error_kept))
        np.add.at(diagonal, tilt_node, np.einsum("eii->ei", tilt_blocks))
        tilt_end = self._num_edge_blocks + len(tilt_node)
        blocks[self._num_edge_blocks : tilt_end] = tilt_blocks
        blocks[tilt_end:] = diagonal[:, :, None] * np.eye(6)
        return _Linearization(
            cost=float(np.sum(rho) + np.sum(tilt_error**2)),
            gradient=gradient.reshape(-1),
            blocks=blocks,
        )

    def _step(self, T_G_I: F64, linear: _Linearization, damping: float) -> F64 | None:
        """Return the poses after one damped Gauss-Newton step; None when it has no solution."""
        undamped = linear.blocks[-len(self._free) :].copy()
        linear.blocks[-len(self._free) :] *= damping
        try:
            self._solver.factor(linear.blocks)
        except NotPositiveDefinite:
            return None
        finally:
            linear.blocks[-len(self._free) :] = undamped
        step = self._solver.solve(-linear.gradient).reshape(-1, 6)
        moved = T_G_I.copy()
        moved[self._free] = _moved(T_G_I[self._free], step)
        return moved if bool(np.isfinite(moved).all()) else None


def _moved(T_G_I: F64, step: F64) -> F64:
    """Move poses (N, 7) along screws whose velocities [dp, dtheta] (N, 6) are the steps.

    Equal to adding dp and turning by dtheta to first order. Where half a trajectory turns about a
    far corner, screws keep its shape and sums stretch it: that saves most of the iterations.
    """
    twist = step.copy()
    twist[:, :3] = so3.rotate(so3.inverse(T_G_I[:, :4]), step[:, :3])
    return se3.compose(T_G_I, se3.exp(twist))
