"""Cost and normal equations of factor terms."""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled, prange
from maplab_py.estimation.kernels.loss import loss_and_weight
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.protocol import FactorTerm

_FACTORS_AT_ONCE = 1024
"""Factors whose blocks are in memory at the same time."""


@dataclasses.dataclass(frozen=True, eq=False)
class FactorSystem:
    """Normal equations of one term, without the blocks."""

    gradient: F64  # (N, n, 3)
    diagonal: F64  # (N, n, 3)
    cost: float


def cost(term: FactorTerm, states: States) -> float:
    """Return half the sum of rho of a term."""
    residual, _ = term.evaluate(states)
    loss, scale = term.loss
    return 0.5 * float(
        np.sum(loss_and_weight(loss, scale * scale, np.einsum("nm,nm->n", residual, residual))[0])
    )


def linearize(
    term: FactorTerm, states: States, add: Callable[[F64, int], None]
) -> tuple[FactorSystem, F64, F64]:
    """Return the normal equations, and the weighted residuals and Jacobians they came from.

    Args:
        term: Term of N factors with n nodes each.
        states: Where to linearise.
        add: Takes blocks (k, 3, 3) of the system from some number on, one per pair of nodes of every
            factor, at `block_places`. The next call overwrites them.
    """
    residual, jacobian, total = weighted(term, states)
    gradient, diagonal = np.empty((*term.nodes.shape, 3)), np.empty((*term.nodes.shape, 3))
    pairs = blocks_each(term.nodes)
    room = np.empty((min(_FACTORS_AT_ONCE, len(residual)), pairs, 3, 3))
    for first in range(0, len(residual), _FACTORS_AT_ONCE):
        part = slice(first, first + _FACTORS_AT_ONCE)
        blocks = room[: len(residual[part])]
        normal_equations(
            residual[part], jacobian[part], term.nodes[part], blocks, gradient[part], diagonal[part]
        )
        add(blocks.reshape(-1, 3, 3), first * pairs)
    return FactorSystem(gradient, diagonal, total), residual, jacobian


def weighted(term: FactorTerm, states: States) -> tuple[F64, F64, float]:
    """Return residuals (N, m) and Jacobians (N, m, 3 n) with the weights of the loss, and the cost."""
    residual, jacobian = term.evaluate(states)
    loss, scale = term.loss
    rho, weight = loss_and_weight(loss, scale * scale, np.einsum("nm,nm->n", residual, residual))
    if loss is not Loss.NONE:
        root = np.sqrt(weight)
        residual, jacobian = residual * root[:, None], jacobian * root[:, None, None]
    total = 0.5 * float(np.sum(rho))
    return np.ascontiguousarray(residual), np.ascontiguousarray(jacobian), total


def blocks_each(nodes: I64) -> int:
    """Return how many blocks every factor of nodes (N, n) has."""
    return int(nodes.shape[1] * (nodes.shape[1] + 1) // 2)


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
    for factor in prange(len(residual)):
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


def compile_kernels() -> None:
    """Compile losses and normal equations on one factor of one node."""
    loss_and_weight(Loss.NONE, 1.0, np.zeros(1))
    node, vector, matrix = np.zeros((1, 1), dtype=np.int64), np.zeros((1, 1, 3)), np.eye(3)[None]
    normal_equations(np.zeros((1, 3)), matrix, node, matrix[None].copy(), vector, vector.copy())
