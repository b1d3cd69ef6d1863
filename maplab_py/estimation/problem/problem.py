"""A least-squares problem: terms, fixed directions of nodes, and its normal equations."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from maplab_py.array_types import F64, I32, I64, NDArray
from maplab_py.estimation.linear.ordering import Ordering, OrderingKind
from maplab_py.estimation.linear.pattern import joint_covariance
from maplab_py.estimation.linear.supernodal_solver import BlockPlaces, SupernodalCholesky
from maplab_py.estimation.problem.protocol import Step
from maplab_py.estimation.problem.trust_region import added_damping
from maplab_py.estimation.states import NODE_NAMES, NODES_PER_VERTEX, States
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.visual import VisualTerms


@dataclasses.dataclass(frozen=True, eq=False)
class Linearization:
    """The normal equations at some states, and the data to evaluate a step.

    The matrix itself is in the storage of the linear solver, whose factor replaces it.
    """

    states: States  # where the equations were formed
    landmark_damping: float  # of the landmarks' elimination
    gradient: F64  # (nodes, 3)
    diagonal: F64  # (nodes, 3) of the unreduced equations
    factors: list[tuple[I64, F64, F64]]  # nodes, weighted residuals, weighted Jacobians
    costs: dict[str, float]

    @property
    def cost(self) -> float:
        """Half the sum of all rho."""
        return sum(self.costs.values())

    def promised_by_factors(self, step: F64) -> float:
        """Return by how much a step (nodes, 3) decreases the linearised cost of the factors."""
        promised = 0.0
        for nodes, residual, jacobian in self.factors:
            change = np.einsum("nmk,nk->nm", jacobian, step[nodes].reshape(len(nodes), -1))
            promised -= float(np.sum(change * (residual + 0.5 * change)))
        return promised


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
        ordering: OrderingKind = OrderingKind.AUTO,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """Analyse the structure of the normal equations for states of this layout.

        Args:
            states: States of this layout.
            visual: Observations of landmarks, None without.
            factors: All other terms.
            ordering: Orders the nodes.
            tell: Shows how large the factor is.
        """
        self.num_nodes = states.num_nodes
        self.visual, self.factors = visual, tuple(factors)
        self._projector = np.tile(np.eye(3), (self.num_nodes, 1, 1))
        self._restricted = np.zeros(self.num_nodes, dtype=np.bool_)
        self.restrict(*states.blocks.padding(states.num_vertex_nodes))
        self._tell = tell
        self._analyse(states, Ordering(ordering, states.node_positions))

    def _analyse(self, states: States, ordering: Ordering) -> None:
        """Analyse the blocks of the normal equations and make room for them."""
        self._assembled: Linearization | None = None  # whose matrix is in the solver's storage
        rows, cols = self.block_places(states)
        self._solver = SupernodalCholesky(rows, cols, self.num_nodes, 3, ordering, self._tell)
        del rows, cols
        self._visual_places = None
        if self.visual is not None:
            self._visual_places = self.visual.places(states, self._solver)
        self._factor_places = [
            BlockPlaces.of(self._solver, *factor_terms.block_places(term.nodes))
            for term in self.factors
        ]

    def block_places(self, states: States) -> tuple[I32, I32]:
        """Return node row and column (B,) of every block of the normal equations; some repeat."""
        every = np.arange(self.num_nodes, dtype=np.int32)
        rows, cols = [every], [every]
        if self.visual is not None:
            visual_rows, visual_cols = self.visual.block_nodes(states)
            rows.append(visual_rows)
            cols.append(visual_cols)
        for term in self.factors:
            term_rows, term_cols = factor_terms.block_places(term.nodes)
            rows.append(term_rows.astype(np.int32))
            cols.append(term_cols.astype(np.int32))
        return np.concatenate(rows), np.concatenate(cols)

    def restrict(self, nodes: I64, projectors: F64) -> None:
        """Restrict steps of nodes (k,) to the range of projectors (k, 3, 3); fixed nodes stay fixed."""
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
    def solver(self) -> SupernodalCholesky | None:
        """The direct linear solver; None where there is none."""
        return self._solver

    @property
    def linear_solver(self) -> str:
        """Name of the linear solver."""
        return "multifrontal"

    @property
    def linear_iterations(self) -> int:
        """Iterations of the linear solver so far; a direct one has none."""
        return 0

    def blocks(self, linear: Linearization, rows: I32, cols: I32) -> F64:
        """Return blocks (B, 3, 3) of the matrix at node rows and columns (B,), without damping."""
        self._assemble(linear)
        return self._solver.blocks(rows, cols)

    def can_move(self, nodes: I64) -> NDArray[np.bool_]:
        """Tell for each of the three directions (..., 3) of nodes whether it may move at all."""
        return np.asarray(np.abs(self._projector[nodes]).sum(axis=-1) > 0.0)

    def degrees_of_freedom(self) -> int:
        """Return the number of directions in which nodes may move."""
        return round(float(np.trace(self._projector, axis1=1, axis2=2).sum()))

    def relinearize(self, states: States) -> bool:
        """Move the terms' linearisation points to the states; return whether costs may have changed."""
        changed = [term.relinearize(states) for term in self.factors]
        return any(changed)

    def linearize(self, states: States, damping: float) -> Linearization:
        """Form the normal equations; `damping` enters the elimination of the landmarks."""
        gradient = np.zeros((self.num_nodes, 3))
        diagonal = np.zeros((self.num_nodes, 3))
        costs: dict[str, float] = {}
        solver = self._solver
        self._assembled = None
        solver.clear()
        if self.visual is not None and self._visual_places is not None:
            system = self.visual.linearize(states, damping, solver, self._visual_places)
            gradient += system.gradient
            diagonal += system.diagonal
            costs["visual"] = system.cost
        evaluated = []
        for term, places in zip(self.factors, self._factor_places, strict=True):
            factor, residual, jacobian = factor_terms.linearize(
                term, states, partial(places.add, solver)
            )
            np.add.at(gradient, term.nodes, factor.gradient)
            np.add.at(diagonal, term.nodes, factor.diagonal)
            evaluated.append((term.nodes, residual, jacobian))
            costs[term.name] = costs.get(term.name, 0.0) + factor.cost
        self._assembled = Linearization(states, damping, gradient, diagonal, evaluated, costs)
        return self._assembled

    def _assemble(self, linear: Linearization) -> None:
        """Form the matrix of a linearisation again, unless it is in the solver's storage."""
        if self._assembled is not linear:
            self.linearize(linear.states, linear.landmark_damping)
            self._assembled = linear

    def solve(self, linear: Linearization, damping: float) -> F64:
        """Return the damped Gauss-Newton step (nodes, 3).

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        gradient = self._factorise(linear, damping)
        step = self._solver.solve(-gradient.reshape(-1, 1)).reshape(-1, 3)
        held = np.flatnonzero(self._restricted)
        step[held] = np.einsum("nij,nj->ni", self._projector[held], step[held])
        return np.asarray(step)

    def try_step(self, states: States, linear: Linearization, damping: float) -> Step[States]:
        """Return the states after the damped Gauss-Newton step, landmarks moved along with it.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        return self._take_step(states, linear, damping, self.solve(linear, damping))

    def _take_step(
        self, states: States, linear: Linearization, damping: float, step: F64
    ) -> Step[States]:
        """Return the states after a step (nodes, 3) of the nodes, landmarks moved along with it."""
        moved, promised = states.moved(step, states.p_G), 0.0
        costs: dict[str, float] = {}
        if self.visual is not None:
            p_G, costs["visual"], promised = self.visual.take_step(states, step, moved, damping)
            moved = dataclasses.replace(moved, p_G=p_G)
        for term in self.factors:
            costs[term.name] = costs.get(term.name, 0.0) + factor_terms.cost(term, moved)
        promised += linear.promised_by_factors(step)
        return Step(moved, costs, promised, states.step_size(step, moved))

    def is_stationary(self, linear: Linearization, tolerance: float) -> bool:
        """Return whether no entry of the gradient is above a tolerance; landmarks must not move."""
        if self.visual is not None and self.visual.moves_points:
            return False  # their gradient is not known
        return bool(np.abs(self.projected_gradient(linear)).max(initial=0.0) <= tolerance)

    def norm(self, states: States) -> float:
        """Return the norm of all values, as that of a step counts them."""
        return states.size()

    def factorise(self, linear: Linearization, damping: float) -> None:
        """Factorise the damped equations.

        Raises:
            NotPositiveDefinite: They are singular.
        """
        self._factorise(linear, damping)

    def marginal_covariance(self, nodes: I64) -> F64:
        """Return the joint covariance (3 k, 3 k) of nodes (k,) after `factorise` without damping."""
        joint = joint_covariance(self._solver.solve, nodes, self.num_nodes, 3)
        covariance = joint.reshape(len(nodes), 3, len(nodes), 3)
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
        """Return the description of a node's state."""
        if node < states.num_vertex_nodes:
            return f"the {NODE_NAMES[node % NODES_PER_VERTEX]} of vertex {node // NODES_PER_VERTEX}"
        for block in states.blocks:
            rows, _ = np.nonzero(states.nodes(block.name) == node)
            if len(rows):
                return f"{block.name} {int(rows[0])}"
        raise ValueError(f"there is no node {node}")

    def _factorise(self, linear: Linearization, damping: float) -> F64:
        """Factorise the projected, damped equations; return the projected gradient."""
        self._assemble(linear)
        self._assembled = None
        added = added_damping(linear.diagonal, damping)
        self._solver.add_to_diagonal(added)
        # directions that must not move get a pivot of the others' size: one that is small against
        # them would drown in their rounding errors
        size = (linear.diagonal + added).max(axis=1, initial=1.0)
        self._solver.project(self._restricted, self._projector, size)
        gradient = linear.gradient.copy()
        held = np.flatnonzero(self._restricted)
        gradient[held] = np.einsum("nij,nj->ni", self._projector[held], gradient[held])
        self._solver.factorise()
        return gradient

    def projected_gradient(self, linear: Linearization) -> F64:
        """Return the gradient (nodes, 3) along the directions that may move."""
        return np.asarray(np.einsum("nij,nj->ni", self._projector, linear.gradient))
