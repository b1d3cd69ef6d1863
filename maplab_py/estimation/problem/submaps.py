"""The joint least-squares problem solved submap by submap, in little more than the memory of one of them.

A submap is what the top separators of a nested dissection leave of the graph of vertices: no landmark
and no other measurement joins two of them. In each iteration the terms of one submap after another are
linearised, its states are eliminated exactly, and its marginal on the separators is added to theirs;
separators are eliminated after what lies below them, and all states follow by back-substitution. Steps
are those of the joint problem but for the order of sums, and so are costs and the optimum.

A part is a submap or a separator; see `linear.submap_plan`.
"""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NoReturn

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.estimation.kernels.visual_arguments import VisualTarget
from maplab_py.estimation.linear import protocol, submap_solver, supernodal_solver
from maplab_py.estimation.linear.nested_dissection import has_metis
from maplab_py.estimation.linear.ordering import Ordering, OrderingKind
from maplab_py.estimation.problem.problem import (
    LARGEST_DAMPED,
    SMALLEST_DAMPED,
    Linearization,
    Problem,
)
from maplab_py.estimation.states import NODES_PER_VERTEX, States
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.visual import (
    VisualPlaces,
    VisualTerms,
    node_blocks,
    pose_part,
)
from maplab_py.estimation.terms.visual_structure import EliminationPlan
from maplab_py.vimap.table import ragged_rows

_FACTORS_AT_ONCE = 1024


@dataclasses.dataclass(frozen=True, eq=False)
class _VisualPart:
    """The landmarks of a part."""

    landmarks: I64  # (l,)
    rows: I64  # (o,) of their observations
    vertices: I64  # (v,) that see them, ascending
    vertex: I32  # (o,) place in `vertices`
    plan: EliminationPlan
    places: I32  # of the plan's blocks in the solver's storage


@dataclasses.dataclass(frozen=True, eq=False)
class _FactorPart:
    """The factors of one term that belong to a part."""

    rows: I64  # (f,)
    places: supernodal_solver.BlockPlaces


@dataclasses.dataclass(frozen=True, eq=False)
class _Part:
    """All terms of a part, and the nodes that are eliminated with it."""

    nodes: I64  # (n,)
    visual: _VisualPart | None
    factors: tuple[_FactorPart, ...]  # by term


class SubmapProblem(Problem):
    """A `Problem` of which only one submap's equations are in memory."""

    def __init__(
        self,
        states: States,
        visual: VisualTerms | None,
        factors: Sequence[FactorTerm],
        submaps: int,
        ordering: OrderingKind = OrderingKind.AUTO,
        make_direct: Callable[[], Problem] | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """Analyse the structure of the normal equations and cut it into submaps.

        Args:
            states: Initial states.
            visual: Reprojection errors of cameras that are not estimated.
            factors: All other terms.
            submaps: Largest number of submaps.
            ordering: Elimination order; AUTO dissects, since only that leaves parts of about one size.
            make_direct: Makes the same problem for the direct solver, nothing restricted: for covariances.
            tell: Shows how much is in memory.

        Raises:
            NotEnoughMemory: A submap does not fit.
            ValueError: The cameras are estimated.
        """
        if visual is not None and visual.estimates_cameras:
            raise ValueError("submaps do not support cameras that are estimated")
        self._wanted = submaps
        self._make_direct = make_direct or partial(Problem, states, visual, factors)
        self._covariance_problem: Problem | None = None
        self._eliminated: tuple[Linearization, float] | None = None  # and damping of the nodes
        self._singular: protocol.NotPositiveDefinite | None = None
        if ordering is OrderingKind.AUTO and (has_metis() or visual is not None):
            ordering = OrderingKind.NESTED_DISSECTION
        super().__init__(states, visual, factors, ordering, tell)

    def _analyse(self, states: States, ordering: Ordering) -> None:
        rows, cols = self.block_places(states)
        if self.visual is not None:
            self.visual.forget_plan()
        self._submaps = submap_solver.SubmapCholesky(
            rows, cols, self.num_nodes, 3, self._wanted, ordering, self._tell
        )
        del rows, cols
        node_part = self._submaps.node_part
        self._parts = [
            _Part(
                np.flatnonzero(node_part == k),
                self._visual_part(k, node_part),
                tuple(self._factor_part(k, term, node_part) for term in self.factors),
            )
            for k in range(len(self._submaps.submaps))
        ]

    def _visual_part(self, part: int, node_part: I64) -> _VisualPart | None:
        """Return the landmarks of a part: the first of the parts that see them."""
        if self.visual is None:
            return None
        data = self.visual.observations
        of_vertex = node_part[: NODES_PER_VERTEX * self.visual.num_vertices]
        of_vertex = of_vertex.reshape(-1, NODES_PER_VERTEX)[:, :2].min(axis=1)
        is_seen = np.diff(data.start) > 0
        of_landmark = np.full(len(is_seen), -1)
        if len(data):
            first = np.minimum(data.start[:-1], len(data) - 1)
            of_landmark[is_seen] = np.minimum.reduceat(of_vertex[data.vertex], first[is_seen])
        landmarks = np.flatnonzero(of_landmark == part)
        if not len(landmarks):
            return None
        rows = ragged_rows(data.start, landmarks)
        vertices, vertex = np.unique(data.vertex[rows], return_inverse=True)
        short = vertex.astype(np.int32)
        plan = self.visual.part(landmarks, rows, short, len(vertices), None).plan
        block_rows = vertices[plan.rows].astype(np.int32)
        block_cols = vertices[plan.cols].astype(np.int32)
        places = self._submaps.places(*node_blocks(block_rows, block_cols))
        return _VisualPart(landmarks, rows, vertices.astype(np.int64), short, plan, places)

    def _factor_part(self, part: int, term: FactorTerm, node_part: I64) -> _FactorPart:
        rows = np.flatnonzero(node_part[term.nodes].min(axis=1) == part)
        block_rows, block_cols = factor_terms.block_places(term.nodes[rows])
        short_rows, short_cols = block_rows.astype(np.int32), block_cols.astype(np.int32)
        places = self._submaps.places(short_rows, short_cols)
        return _FactorPart(rows, supernodal_solver.BlockPlaces(short_rows, short_cols, places))

    @property
    def num_submaps(self) -> int:
        """Number of submaps."""
        return self._submaps.count

    @property
    def solver(self) -> supernodal_solver.SupernodalCholesky | None:
        """None: the matrix is never in one storage."""
        return None

    @property
    def linear_solver(self) -> str:
        """Name of the linear solver."""
        return f"{self._submaps.count} submaps"

    def blocks(self, linear: Linearization, rows: I32, cols: I32) -> NoReturn:  # noqa: ARG002
        """Raise: the matrix is never in one storage."""
        raise ValueError("submaps keep no blocks of the normal equations")

    def linearize(self, states: States, damping: float) -> Linearization:
        """Linearise all submaps and eliminate them, with that damping of landmarks and other states."""
        return self._eliminate(states, damping, damping)

    def _eliminate(self, states: States, landmark_damping: float, damping: float) -> Linearization:
        self._eliminated = self._singular = None
        gradient, diagonal = np.zeros((self.num_nodes, 3)), np.zeros((self.num_nodes, 3))
        costs = {"visual": 0.0} if self.visual is not None else {}
        evaluated = []
        for term in self.factors:
            residual, jacobian, cost = factor_terms.weighted(term, states)
            evaluated.append((term.nodes, residual, jacobian))
            costs[term.name] = costs.get(term.name, 0.0) + cost
        self._submaps.start()
        for number, part in enumerate(self._parts):
            self._submaps.select(number)
            if part.visual is not None:
                costs["visual"] += self._add_visual(
                    states, landmark_damping, part.visual, gradient, diagonal
                )
            for factor, values in zip(part.factors, evaluated, strict=True):
                self._add_factors(factor, values, gradient, diagonal)
            self._damp(part.nodes, gradient, diagonal, damping)
            if self._singular is None:
                try:
                    self._submaps.eliminate()
                except protocol.NotPositiveDefinite as error:
                    self._singular = error
        linear = Linearization(states, landmark_damping, gradient, diagonal, evaluated, costs)
        self._eliminated = linear, damping
        return linear

    def _add_visual(
        self, states: States, damping: float, part: _VisualPart, gradient: F64, diagonal: F64
    ) -> float:
        """Eliminate the landmarks of a part; return their cost."""
        if self.visual is None:
            return 0.0
        terms = self.visual.part(
            part.landmarks, part.rows, part.vertex, len(part.vertices), part.plan
        )
        local = States(
            states.T_G_I[part.vertices],
            states.v_G[part.vertices],
            states.gyro_bias[part.vertices],
            states.accel_bias[part.vertices],
            states.p_G[part.landmarks],
        )
        nodes = NODES_PER_VERTEX * part.vertices[:, None] + np.arange(NODES_PER_VERTEX)
        layout, flat = self._submaps.layout, nodes.reshape(-1)
        target = VisualTarget(
            NODES_PER_VERTEX, part.places, layout.position[flat], layout.column_start[flat],
            layout.leading[flat],
        )  # fmt: skip
        system = terms.linearize(local, damping, self._submaps, VisualPlaces(target, None))
        pose_part(gradient, states)[part.vertices] += pose_part(system.gradient, local)
        pose_part(diagonal, states)[part.vertices] += pose_part(system.diagonal, local)
        return system.cost

    def _add_factors(
        self, part: _FactorPart, values: tuple[I64, F64, F64], gradient: F64, diagonal: F64
    ) -> None:
        """Add the factors of a part, some at a time."""
        nodes, residual, jacobian = values
        pairs = factor_terms.blocks_each(nodes)
        for first in range(0, len(part.rows), _FACTORS_AT_ONCE):
            rows = part.rows[first : first + _FACTORS_AT_ONCE]
            blocks = np.empty((len(rows), pairs, 3, 3))
            each = np.empty((2, *nodes[rows].shape, 3))
            factor_terms.normal_equations(
                residual[rows], jacobian[rows], nodes[rows], blocks, each[0], each[1]
            )
            np.add.at(gradient, nodes[rows], each[0])
            np.add.at(diagonal, nodes[rows], each[1])
            part.places.add(self._submaps, blocks.reshape(-1, 3, 3), first * pairs)

    def _damp(self, nodes: I64, gradient: F64, diagonal: F64, damping: float) -> None:
        """Damp and project the nodes that are eliminated next, and set their right side."""
        added = damping * np.clip(diagonal[nodes], SMALLEST_DAMPED, LARGEST_DAMPED)
        self._submaps.add_to_diagonal(nodes, added)
        size = np.ones(self.num_nodes)
        size[nodes] = (diagonal[nodes] + added).max(axis=1, initial=1.0)
        self._submaps.project(self._restricted, self._projector, size)
        projected = np.einsum("nij,nj->ni", self._projector[nodes], gradient[nodes])
        self._submaps.add_to_right_side(nodes, -projected)

    def solve(self, linear: Linearization, damping: float) -> F64:
        """Return the damped Gauss-Newton step (nodes, 3).

        Raises:
            NotPositiveDefinite: The damped equations are singular.
            EstimationError: The factor of a submap cannot be kept on disk.
        """
        if self._eliminated is None or self._eliminated != (linear, damping):
            self._eliminate(linear.states, linear.landmark_damping, damping)
        self._eliminated = None  # the right side is replaced by the solution
        if self._singular is not None:
            raise self._singular
        step = self._submaps.solve()
        held = np.flatnonzero(self._restricted)
        step[held] = np.einsum("nij,nj->ni", self._projector[held], step[held])
        return step

    def factorise(self, linear: Linearization, damping: float) -> None:
        """Prepare for covariances, by the direct solver.

        Raises:
            NotPositiveDefinite: The equations are singular.
            NotEnoughMemory: The direct solver does not fit.
        """
        direct = self._make_direct()
        held = np.flatnonzero(self._restricted)
        direct.restrict(held, self._projector[held])
        direct.factorise(direct.linearize(linear.states, linear.landmark_damping), damping)
        self._covariance_problem = direct

    def marginal_covariance(self, nodes: I64) -> F64:
        """Return the joint covariance (3 k, 3 k) of nodes (k,) after `factorise` without damping."""
        return self._factorised().marginal_covariance(nodes)

    def covariance_columns(self, nodes: I64, directions: I64) -> F64:
        """Return the covariance (nodes, 3, k) of everything with directions (k,) of nodes (k,)."""
        return self._factorised().covariance_columns(nodes, directions)

    def _factorised(self) -> Problem:
        if self._covariance_problem is None:
            raise ValueError("factorise() has to succeed before covariances are asked for")
        return self._covariance_problem
