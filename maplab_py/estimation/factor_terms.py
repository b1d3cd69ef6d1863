"""Terms other than reprojection: factors on the nodes of a few vertices each.

A factor has a residual of size m and touches a list of nodes (three numbers each). Its whitened
Jacobian (m, 3 * nodes) has the columns of the nodes side by side.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

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
    """Normal equations of one term, one block per pair of nodes of each factor."""

    blocks: F64  # (N * n (n + 1) / 2, 3, 3)
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


def linearize(term: FactorTerm, states: States) -> tuple[FactorSystem, F64, F64]:
    """Return the normal equations, and the weighted residuals and Jacobians they came from."""
    residual, jacobian = term.evaluate(states)
    loss, scale = term.loss
    rho, weight = robust(loss, scale * scale, np.einsum("nm,nm->n", residual, residual))
    root = np.sqrt(weight)
    residual, jacobian = residual * root[:, None], jacobian * root[:, None, None]
    count = len(jacobian)
    num = term.nodes.shape[1]
    normal = np.matmul(jacobian.transpose(0, 2, 1), jacobian).reshape(count, num, 3, num, 3)
    b, a = np.tril_indices(num)
    blocks = normal[:, b, :, a, :]  # advanced indexing puts the pair axis first
    system = FactorSystem(
        blocks=np.ascontiguousarray(blocks.transpose(1, 0, 2, 3)).reshape(-1, 3, 3),
        gradient=np.einsum("nmk,nm->nk", jacobian, residual).reshape(count, num, 3),
        diagonal=np.einsum("nmk,nmk->nk", jacobian, jacobian).reshape(count, num, 3),
        cost=0.5 * float(np.sum(rho)),
    )
    return system, residual, jacobian


def block_places(nodes: I64) -> tuple[I64, I64, NDArray[np.bool_]]:
    """Return node row and column of every block of a term, and which ones to transpose.

    A block joins nodes b, a with a <= b in the factor's order; where node a is the later one in
    the system's order the block goes to the mirrored place, transposed.
    """
    b, a = np.tril_indices(nodes.shape[1])
    row, col = nodes[:, b].reshape(-1), nodes[:, a].reshape(-1)
    return np.maximum(row, col), np.minimum(row, col), row < col
