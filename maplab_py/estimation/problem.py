"""A least-squares problem: terms, which nodes may move, and its normal equations."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation import factor_terms
from maplab_py.estimation.factor_terms import FactorTerm
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.states import F64, NODES_PER_VERTEX, States
from maplab_py.estimation.visual_terms import VisualTerms, node_blocks, split_blocks

I64 = NDArray[np.int64]

_SMALLEST_DAMPED, _LARGEST_DAMPED = 1e-6, 1e32


@dataclasses.dataclass(frozen=True, eq=False)
class Linearization:
    """The normal equations at some states, and what is needed to judge a step."""

    values: F64  # 3 x 3 blocks of the system matrix, damping not included
    gradient: F64  # (nodes, 3)
    diagonal: F64  # (nodes, 3) of the unreduced equations
    factors: list[tuple[I64, F64, F64]]  # nodes, weighted residuals, weighted Jacobians
    costs: dict[str, float]

    @property
    def cost(self) -> float:
        """Half the sum of all rho."""
        return sum(self.costs.values())


class Problem:
    """Terms over the states of V vertices, with nodes restricted to subspaces.

    A node that must not move, or not in every direction, has a projector P (3 x 3) onto the
    directions it has: the step of the node is P times an unconstrained one. The equations become
    P A P + (I - P), so fixed directions decouple and get no step. A node fixed altogether has P = 0.
    """

    def __init__(
        self, num_vertices: int, visual: VisualTerms | None, factors: Sequence[FactorTerm]
    ) -> None:
        """Analyse the structure of the normal equations."""
        self.num_nodes = NODES_PER_VERTEX * num_vertices
        self.visual, self.factors = visual, tuple(factors)
        every = np.arange(self.num_nodes, dtype=np.int64)
        rows, cols = [every], [every]
        if visual is not None:
            row, col = node_blocks(visual.pair_row, visual.pair_col)
            self._is_diagonal = visual.pair_row == visual.pair_col
            rows.append(row)
            cols.append(col)
        self._transposed = []
        for term in self.factors:
            row, col, transposed = factor_terms.block_places(term.nodes)
            rows.append(row)
            cols.append(col)
            self._transposed.append(transposed)
        self._rows, self._cols = np.concatenate(rows), np.concatenate(cols)
        self._solver = BlockCholesky(self._rows, self._cols, self.num_nodes, 3)
        self._projector = np.tile(np.eye(3), (self.num_nodes, 1, 1))
        self._restricted = np.zeros(self.num_nodes, dtype=np.bool_)

    def restrict(self, nodes: I64, projectors: F64) -> None:
        """Let nodes (k,) move only in the range of projectors (k, 3, 3); fixed ones stay fixed."""
        is_fixed = ~self._projector[nodes].any(axis=(1, 2), keepdims=True)
        self._projector[nodes] = np.where(is_fixed, 0.0, projectors)
        self._restricted[nodes] = True

    def fix(self, nodes: I64) -> None:
        """Keep nodes (k,) where they are."""
        self.restrict(nodes, np.zeros((len(nodes), 3, 3)))

    def linearize(self, states: States, damping: float) -> Linearization:
        """Form the normal equations; `damping` enters the elimination of the landmarks."""
        gradient = np.zeros((self.num_nodes, 3))
        diagonal = np.zeros((self.num_nodes, 3))
        values, costs = [np.zeros((self.num_nodes, 3, 3))], {}
        if self.visual is not None:
            system = self.visual.linearize(states.T_G_I, states.p_G, damping)
            values.append(split_blocks(system.blocks, self._is_diagonal))
            _pose_part(gradient)[:] += system.gradient
            _pose_part(diagonal)[:] += system.diagonal
            costs["visual"] = system.cost
        evaluated = []
        for term, transposed in zip(self.factors, self._transposed, strict=True):
            factor, residual, jacobian = factor_terms.linearize(term, states)
            blocks = factor.blocks
            blocks[transposed] = blocks[transposed].transpose(0, 2, 1)
            values.append(blocks)
            np.add.at(gradient, term.nodes, factor.gradient)
            np.add.at(diagonal, term.nodes, factor.diagonal)
            evaluated.append((term.nodes, residual, jacobian))
            costs[term.name] = factor.cost
        return Linearization(np.concatenate(values), gradient, diagonal, evaluated, costs)

    def solve(self, linear: Linearization, damping: float) -> F64:
        """Return the damped Gauss-Newton step (V, 5, 3) of the vertices' nodes.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        values = linear.values.copy()
        added = damping * np.clip(linear.diagonal, _SMALLEST_DAMPED, _LARGEST_DAMPED)
        values[: self.num_nodes] = added[:, :, None] * np.eye(3)
        gradient = linear.gradient.copy()
        self._project(values, gradient)
        self._solver.factor(values)
        step = self._solver.solve(-gradient.reshape(-1)).reshape(-1, 3)
        held = np.flatnonzero(self._restricted)
        step[held] = np.einsum("nij,nj->ni", self._projector[held], step[held])
        return np.asarray(step.reshape(-1, NODES_PER_VERTEX, 3))

    def _project(self, values: F64, gradient: F64) -> None:
        """Apply the projectors to blocks and gradient, in place."""
        held = np.flatnonzero(self._restricted)
        touched = np.flatnonzero(self._restricted[self._rows] | self._restricted[self._cols])
        left, right = self._projector[self._rows[touched]], self._projector[self._cols[touched]]
        values[touched] = left @ values[touched] @ right
        values[held] += np.eye(3) - self._projector[held]
        gradient[held] = np.einsum("nij,nj->ni", self._projector[held], gradient[held])

    def projected_gradient(self, linear: Linearization) -> F64:
        """Return the gradient (nodes, 3) along the directions that may move."""
        return np.asarray(np.einsum("nij,nj->ni", self._projector, linear.gradient))


def _pose_part(by_node: F64) -> F64:
    """View the position and orientation nodes of (nodes, 3) as (V, 6)."""
    by_vertex = by_node.reshape(-1, NODES_PER_VERTEX * 3)
    return by_vertex[:, :6]
