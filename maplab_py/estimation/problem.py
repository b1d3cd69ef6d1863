"""A least-squares problem: terms, which nodes may move, and its normal equations."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation import factor_terms
from maplab_py.estimation.factor_terms import FactorTerm
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.linear.superlu import SuperLUSolver
from maplab_py.estimation.states import F64, NODE_NAMES, NODES_PER_VERTEX, States
from maplab_py.estimation.visual_terms import VisualTerms
from maplab_py.vimap.table import starts_of_counts

I64 = NDArray[np.int64]

_SMALLEST_DAMPED, _LARGEST_DAMPED = 1e-6, 1e32


@dataclasses.dataclass(frozen=True, eq=False)
class Linearization:
    """The normal equations at some states, and what is needed to judge a step.

    The next linearisation of the same problem writes into the same `values`.
    """

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
    P A P + s (I - P), so fixed directions decouple and get no step. A node fixed altogether has P = 0.
    """

    def __init__(
        self,
        states: States,
        visual: VisualTerms | None,
        factors: Sequence[FactorTerm],
        linear_solver: type[BlockCholesky] | type[SuperLUSolver] = BlockCholesky,
    ) -> None:
        """Analyse the structure of the normal equations for states of this layout."""
        self.num_nodes = states.num_nodes
        self.visual, self.factors = visual, tuple(factors)
        every = np.arange(self.num_nodes, dtype=np.int64)
        places = [(every, every)]
        if visual is not None:
            places.append(visual.block_nodes(states))
        places += [factor_terms.block_places(term.nodes) for term in self.factors]
        self._rows, self._cols = (np.concatenate(part) for part in zip(*places, strict=True))
        self._part_start = starts_of_counts(np.array([len(rows) for rows, _ in places]))
        self._solver = linear_solver(self._rows, self._cols, self.num_nodes, 3)
        self._values = np.zeros((len(self._rows), 3, 3))
        self._damped = np.empty_like(self._values)
        self._projector = np.tile(np.eye(3), (self.num_nodes, 1, 1))
        self._restricted = np.zeros(self.num_nodes, dtype=np.bool_)
        self.restrict(*states.blocks.padding(states.num_vertex_nodes))

    def restrict(self, nodes: I64, projectors: F64) -> None:
        """Let nodes (k,) move only in the range of projectors (k, 3, 3); fixed ones stay fixed."""
        is_fixed = ~self._projector[nodes].any(axis=(1, 2), keepdims=True)
        self._projector[nodes] = np.where(is_fixed, 0.0, projectors)
        self._restricted[nodes] = True

    def fix(self, nodes: I64) -> None:
        """Keep nodes (k,) where they are."""
        self.restrict(nodes, np.zeros((len(nodes), 3, 3)))

    @property
    def projectors(self) -> F64:
        """Projectors (nodes, 3, 3) onto the directions in which nodes may move."""
        return self._projector

    @property
    def block_places(self) -> tuple[I64, I64]:
        """Node row and column (B,) of every block of a linearisation's values."""
        return self._rows, self._cols

    def can_move(self, nodes: I64) -> NDArray[np.bool_]:
        """Tell for each of the three directions (..., 3) of nodes whether it may move at all."""
        return np.asarray(np.abs(self._projector[nodes]).sum(axis=-1) > 0.0)

    def degrees_of_freedom(self) -> int:
        """Return the number of directions in which nodes may move."""
        return round(float(np.trace(self._projector, axis1=1, axis2=2).sum()))

    def linearize(self, states: States, damping: float) -> Linearization:
        """Form the normal equations; `damping` enters the elimination of the landmarks."""
        gradient = np.zeros((self.num_nodes, 3))
        diagonal = np.zeros((self.num_nodes, 3))
        costs: dict[str, float] = {}
        parts = self._parts()
        if self.visual is not None:
            system = self.visual.node_system(states, damping, next(parts))
            gradient += system.gradient
            diagonal += system.diagonal
            costs["visual"] = system.cost
        evaluated = []
        for term, blocks in zip(self.factors, parts, strict=True):
            factor, residual, jacobian = factor_terms.linearize(term, states, blocks)
            np.add.at(gradient, term.nodes, factor.gradient)
            np.add.at(diagonal, term.nodes, factor.diagonal)
            evaluated.append((term.nodes, residual, jacobian))
            costs[term.name] = costs.get(term.name, 0.0) + factor.cost
        return Linearization(self._values, gradient, diagonal, evaluated, costs)

    def _parts(self) -> Iterator[F64]:
        """Yield the values of the visual terms, if there are any, and of each factor term."""
        for first, end in zip(self._part_start[1:-1], self._part_start[2:], strict=True):
            yield self._values[first:end]

    def costs(self, states: States) -> dict[str, float]:
        """Return the cost of every term, without forming any equations."""
        costs = {} if self.visual is None else {"visual": self.visual.cost(states)}
        for term in self.factors:
            costs[term.name] = costs.get(term.name, 0.0) + factor_terms.cost(term, states)
        return costs

    def solve(self, linear: Linearization, damping: float) -> F64:
        """Return the damped Gauss-Newton step (nodes, 3).

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        gradient = self._factorise(linear, damping)
        step = self._solver.solve(-gradient.reshape(-1)).reshape(-1, 3)
        held = np.flatnonzero(self._restricted)
        step[held] = np.einsum("nij,nj->ni", self._projector[held], step[held])
        return np.asarray(step)

    def factorise(self, linear: Linearization, damping: float) -> None:
        """Factorise the damped equations.

        Raises:
            NotPositiveDefinite: They are singular.
        """
        self._factorise(linear, damping)

    def marginal_covariance(self, nodes: I64) -> F64:
        """Return the joint covariance (3 k, 3 k) of nodes (k,) after `factorise` without damping."""
        covariance = self._solver.marginal_covariance(nodes).reshape(len(nodes), 3, len(nodes), 3)
        P = self._projector[nodes]
        projected = np.einsum("nij,njmk,mkl->niml", P, covariance, P)
        return np.asarray(projected.reshape(3 * len(nodes), -1))

    def covariance_columns(self, nodes: I64, directions: I64) -> F64:
        """Return the covariance (nodes, 3, k) of everything with directions (k,) of nodes (k,).

        After `factorise` without damping; landmarks that were eliminated are not among the nodes.
        """
        sides = np.zeros((self.num_nodes, 3, len(nodes)))
        sides[nodes, directions, np.arange(len(nodes))] = 1.0
        columns = self._solver.solve(sides.reshape(3 * self.num_nodes, -1)).reshape(sides.shape)
        return np.asarray(np.einsum("nij,njk->nik", self._projector, columns))

    def name_of_node(self, states: States, node: int) -> str:
        """Say in words which state a node belongs to."""
        if node < states.num_vertex_nodes:
            return f"the {NODE_NAMES[node % NODES_PER_VERTEX]} of vertex {node // NODES_PER_VERTEX}"
        for block in states.blocks:
            rows, _ = np.nonzero(states.nodes(block.name) == node)
            if len(rows):
                return f"{block.name} {int(rows[0])}"
        raise ValueError(f"there is no node {node}")

    def _factorise(self, linear: Linearization, damping: float) -> F64:
        """Factorise the projected, damped equations; return the projected gradient."""
        values = self._damped
        np.copyto(values, linear.values)
        added = damping * np.clip(linear.diagonal, _SMALLEST_DAMPED, _LARGEST_DAMPED)
        values[: self.num_nodes] = added[:, :, None] * np.eye(3)
        gradient = linear.gradient.copy()
        self._project(values, gradient, (linear.diagonal + added).max(axis=1, initial=1.0))
        self._solver.factor(values)
        return gradient

    def _project(self, values: F64, gradient: F64, size: F64) -> None:
        """Apply the projectors to blocks and gradient, in place.

        The directions that must not move get the pivot `size` (nodes,): one that is small against
        the others would drown in their rounding errors.
        """
        held = np.flatnonzero(self._restricted)
        touched = np.flatnonzero(self._restricted[self._rows] | self._restricted[self._cols])
        left, right = self._projector[self._rows[touched]], self._projector[self._cols[touched]]
        values[touched] = left @ values[touched] @ right
        values[held] += size[held, None, None] * (np.eye(3) - self._projector[held])
        gradient[held] = np.einsum("nij,nj->ni", self._projector[held], gradient[held])

    def projected_gradient(self, linear: Linearization) -> F64:
        """Return the gradient (nodes, 3) along the directions that may move."""
        return np.asarray(np.einsum("nij,nj->ni", self._projector, linear.gradient))
