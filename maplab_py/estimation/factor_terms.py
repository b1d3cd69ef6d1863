"""Terms other than reprojection: factors on the nodes of a few vertices each.

A factor has a residual of size m and touches a list of nodes (three numbers each). Its whitened
Jacobian (m, 3 * nodes) has the columns of the nodes side by side.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numba
import numpy as np
from numpy.typing import NDArray

from maplab_py.compilation import compiled
from maplab_py.estimation.loss import Loss, robust
from maplab_py.estimation.states import F64, States

I64 = NDArray[np.int64]


class FactorTerm(Protocol):
    """What the solver needs of a term; a plugin may bring its own."""

    @property
    def name(self) -> str:
        """Name in the report."""

    @property
    def nodes(self) -> I64:
        """Nodes (N, n) that each factor touches: 5 * vertex + kind, see `states`."""

    @property
    def loss(self) -> tuple[Loss, float]:
        """Robust loss and its scale in sigmas."""

    def evaluate(self, states: States) -> tuple[F64, F64]:
        """Return whitened residuals (N, m) and Jacobians (N, m, 3 n)."""


@dataclasses.dataclass(frozen=True, eq=False)
class FactorSystem:
    """Normal equations of one term; the blocks are where `linearize` was told."""

    gradient: F64  # (N, n, 3)
    diagonal: F64  # (N, n, 3)
    cost: float


def cost(term: FactorTerm, states: States) -> float:
    """Return half the sum of rho of a term."""
    residual, _ = term.evaluate(states)
    loss, scale = term.loss
    return 0.5 * float(
        np.sum(robust(loss, scale * scale, np.einsum("nm,nm->n", residual, residual))[0])
    )


def linearize(term: FactorTerm, states: States, blocks: F64) -> tuple[FactorSystem, F64, F64]:
    """Return the normal equations, and the weighted residuals and Jacobians they came from.

    Args:
        term: Term of N factors with n nodes each.
        states: Where to linearise.
        blocks: Result (N n (n + 1) / 2, 3, 3): one block per pair of nodes, at `block_places`.
    """
    residual, jacobian = term.evaluate(states)
    loss, scale = term.loss
    rho, weight = robust(loss, scale * scale, np.einsum("nm,nm->n", residual, residual))
    if loss is not Loss.NONE:
        root = np.sqrt(weight)
        residual, jacobian = residual * root[:, None], jacobian * root[:, None, None]
    gradient, diagonal = np.empty((*term.nodes.shape, 3)), np.empty((*term.nodes.shape, 3))
    normal_equations(
        np.ascontiguousarray(residual), np.ascontiguousarray(jacobian), term.nodes,
        blocks.reshape(len(residual), -1, 3, 3), gradient, diagonal,
    )  # fmt: skip
    return FactorSystem(gradient, diagonal, 0.5 * float(np.sum(rho))), residual, jacobian


@compiled(parallel=True)
def normal_equations(
    residual: F64, jacobian: F64, nodes: I64, blocks: F64, gradient: F64, diagonal: F64
) -> None:
    """Compute J' J by pairs of nodes, J' r, and the diagonal of J' J, of every factor.

    Args:
        residual: (N, m).
        jacobian: (N, m, 3 n).
        nodes: (N, n).
        blocks: Result (N, n (n + 1) / 2, 3, 3), see `block_places`.
        gradient: Result (N, n, 3).
        diagonal: Result (N, n, 3).
    """
    for factor in numba.prange(len(residual)):
        pair = 0
        for b in range(nodes.shape[1]):
            for i in range(3):
                square, product = 0.0, 0.0
                for m in range(residual.shape[1]):
                    entry = jacobian[factor, m, 3 * b + i]
                    square += entry * entry
                    product += entry * residual[factor, m]
                diagonal[factor, b, i] = square
                gradient[factor, b, i] = product
            for a in range(b + 1):
                is_mirrored = nodes[factor, b] < nodes[factor, a]
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for m in range(residual.shape[1]):
                            total += jacobian[factor, m, 3 * b + i] * jacobian[factor, m, 3 * a + j]
                        if is_mirrored:
                            blocks[factor, pair, j, i] = total
                        else:
                            blocks[factor, pair, i, j] = total
                pair += 1


def block_places(nodes: I64) -> tuple[I64, I64]:
    """Return node row and column of every block of a term.

    A block joins nodes b, a with a <= b in the factor's order; where node a is the later one in
    the system's order the block goes to the mirrored place, transposed.
    """
    b, a = np.tril_indices(nodes.shape[1])
    row, col = nodes[:, b].reshape(-1), nodes[:, a].reshape(-1)
    return np.maximum(row, col), np.minimum(row, col)
