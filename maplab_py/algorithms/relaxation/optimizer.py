"""Levenberg-Marquardt on a pose graph, edges as whole columns, normal equations by block Cholesky."""

from __future__ import annotations

import contextlib
import copy
import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation import kernels
from maplab_py.algorithms.relaxation.losses import LOSSES
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors
from maplab_py.errors import EstimationError
from maplab_py.estimation import relative_pose_kernels as edge_kernels
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.ordering import exact_minimum_degree
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.progress import Progress

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_FIRST_DAMPING = 1e-8
_LARGEST_DAMPING = 1e8
_TOLERANCE = 1e-7
_SLOW = 0.02  # of the last decrease: second derivatives pay
_NEAR = 0.05  # relative decrease of the cost; farther off they lead astray
_UNDAMPED = (1e-12, 1e-9, 1e-6)  # enough for parts that no closure holds any more


@dataclasses.dataclass(frozen=True, eq=False)
class _Linearization:
    cost: float
    gradient: F64  # (N, 6) of half the cost, by free pose
    diagonal: F64  # (N, 6) of the Gauss-Newton matrix


class PoseGraphOptimizer:
    """Minimises sum |trajectory|^2 + sum rho(|closure|^2) + sum |tilt|^2 over free poses.

    Gauss-Newton, until that is slow: then second derivatives are added, where residuals are
    logarithms. Those of split residuals are left out.
    """

    def __init__(
        self,
        is_free: NDArray[np.bool_],
        trajectory: RelativePoses,
        loops: RelativePoses,
        tilt: TiltPriors,
        loss: str,
    ) -> None:
        """Prepare the structure of the normal equations."""
        self._edges = RelativePoses.concatenate(trajectory, loops)
        self._num_trajectory = len(trajectory)
        self._trust = np.ones(len(self._edges))
        self._tilt = tilt
        self._loss = LOSSES[loss]
        self._free = np.flatnonzero(is_free)
        size = len(self._free)
        variable = np.full(len(is_free), -1, dtype=np.int64)
        variable[self._free] = np.arange(size)
        self._a = a = variable[self._edges.from_vertex]
        self._b = b = variable[self._edges.to_vertex]
        self._tilted = variable[tilt.vertex]
        # every edge has a block of its own below the diagonal, and every pose one on it
        row, col = np.maximum(a, b), np.minimum(a, b)
        kept = np.flatnonzero(col >= 0)
        first = len(kept)
        self._slot = np.full((len(a), 3), -1, dtype=np.int64)
        self._slot[kept, 2] = np.where(a[kept] > b[kept], -2 - np.arange(first), np.arange(first))
        self._slot[:, 0] = np.where(a >= 0, first + a, -1)
        self._slot[:, 1] = np.where(b >= 0, first + b, -1)
        nodes = np.arange(size)
        self._blocks = np.zeros((first + size, 6, 6))
        self._own = self._blocks[first:]
        self._diagonal = np.einsum("nii->ni", self._own)  # a view
        self._solver = BlockCholesky(
            np.concatenate([row[kept], nodes]),
            np.concatenate([col[kept], nodes]),
            size,
            6,
            ordering=exact_minimum_degree,
        )

    def plain(self) -> PoseGraphOptimizer:
        """Return the same graph without a loss, which shares memory with this one."""
        other = copy.copy(self)
        other._loss = LOSSES["none"]
        other._trust = self._trust.copy()
        return other

    def trust(self, loops: NDArray[np.bool_]) -> None:
        """Leave out the closures (L,) that are False."""
        self._trust[self._num_trajectory :] = loops

    def cost(self, T_G_I: F64, price: float) -> float:
        """Return the sum that is minimised, for poses (V, 7)."""
        graph = (*self._edges.arguments(T_G_I), self._trust, self._num_trajectory)
        tilt = self._tilt
        return float(
            edge_kernels.robust_cost(*graph, self._loss.code, price)
            + kernels.tilt_cost(T_G_I, tilt.vertex, tilt.q_G_I, tilt.sigma_rad)
        )

    def closure_uncertainty(self, T_G_I: F64) -> F64:
        """Return how uncertain closures' errors are by the poses alone: W J Sigma J^T W^T (L, 6, 6).

        With the identity added it is the covariance of the errors of closures that are left out;
        taken from the identity it is that of those which count.

        Raises:
            EstimationError: The poses are not determined.
        """
        linear = self._linearize(T_G_I, 1.0, bend=False)
        for damping in _UNDAMPED:
            self._diagonal += damping * linear.diagonal
            with contextlib.suppress(NotPositiveDefinite):
                self._solver.factor(self._blocks)
                break
        else:
            raise EstimationError("relaxation: the closures do not determine the poses")
        edges = self._edges.take(np.arange(self._num_trajectory, len(self._edges)))
        _, J_a, J_b = edges.linearized(T_G_I)
        slot = self._slot[self._num_trajectory :]
        inverse = np.concatenate([self._solver.inverse_blocks(), np.zeros((1, 6, 6))])
        aa, bb, ba = (inverse[slot[:, part]] for part in range(3))  # the last one, where none is
        turned = slot[:, 2] < -1
        ba[turned] = np.swapaxes(inverse[-2 - slot[turned, 2]], 1, 2)
        cross = J_b @ ba @ np.swapaxes(J_a, 1, 2)
        own = J_a @ aa @ np.swapaxes(J_a, 1, 2) + J_b @ bb @ np.swapaxes(J_b, 1, 2)
        return np.asarray(own + cross + np.swapaxes(cross, 1, 2))

    @single_blas_thread()
    def run(
        self,
        T_G_I: F64,
        price: float,
        max_iterations: int,
        progress: Progress,
        tolerance: float = _TOLERANCE,
    ) -> tuple[F64, int]:
        """Iterate from poses (V, 7); return the new ones and the number of iterations.

        It ends when the decreases, which shrink by some factor from step to step, add up to no more
        than the tolerance times the cost from here on.

        Raises:
            EstimationError: The poses are not determined, or not finite.
        """
        damping, bend, decrease = _FIRST_DAMPING, False, 0.0
        for iteration in range(max_iterations):
            progress.check()
            linear = self._linearize(T_G_I, price, bend)
            if not np.isfinite(linear.cost):
                raise EstimationError("relaxation: the cost of the pose graph is not finite")
            accepted, cost = None, linear.cost
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
            before, decrease = decrease, linear.cost - cost
            ratio = min(decrease / before, 0.999) if before > 0.0 else 0.5
            if decrease * ratio / (1.0 - ratio) <= tolerance * cost:
                return T_G_I, iteration + 1
            bend = bend or (
                self._loss.code == edge_kernels.QUADRATIC
                and decrease < _NEAR * cost
                and ratio > _SLOW
            )
        return T_G_I, max_iterations

    def _linearize(self, T_G_I: F64, price: float, bend: bool) -> _Linearization:
        gradient, diagonal = np.zeros((2, len(self._free), 6))
        self._own[:] = 0.0
        system = (self._slot, self._a, self._b, self._blocks, gradient, diagonal)
        graph = (*self._edges.arguments(T_G_I), self._trust, self._num_trajectory)
        cost = edge_kernels.normal_equations(*graph, self._loss.code, price, bend, *system)
        tilt = (self._tilt.vertex, self._tilt.q_G_I, self._tilt.sigma_rad, self._tilted)
        cost += kernels.add_tilt(T_G_I, *tilt, self._own, gradient, diagonal)
        return _Linearization(float(cost), gradient, diagonal)

    def _step(self, T_G_I: F64, linear: _Linearization, damping: float) -> F64 | None:
        """Return the poses after one damped step; None when it has no solution."""
        undamped = self._diagonal.copy()
        np.add(undamped, damping * linear.diagonal, out=self._diagonal)
        try:
            self._solver.factor(self._blocks)
        except NotPositiveDefinite:
            return None
        finally:
            self._diagonal[:] = undamped
        step = self._solver.solve(-linear.gradient.reshape(-1)).reshape(-1, 6)
        moved: F64 = kernels.moved(T_G_I, self._free, step)
        return moved if bool(np.isfinite(step).all()) else None
