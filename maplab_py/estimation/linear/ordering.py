"""Elimination order of the nodes: the candidate whose factorisation needs the fewest operations.

Minimum degree suits single sessions, nested dissection overlapping trajectories. No rule chooses
between them: the operations of the factorisation are counted for both.
"""

import dataclasses
from enum import Enum
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.errors import FlagError
from maplab_py.estimation.linear.nested_dissection import (
    dissect_by_metis,
    dissect_by_position,
    has_metis,
)
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.quotient_graph import QuotientGraph, indistinguishable_nodes
from maplab_py.estimation.linear.scipy_extensions import scipy_extension

# Eliminating a node connects all its neighbours; eliminating nodes of few neighbours first keeps the
# factor sparse (Liu 1985, multiple minimum degree). SuperLU inside scipy has that algorithm. An
# INCOMPLETE factorisation that drops every off-diagonal entry makes it hand out the order without
# paying for the fill of a factorisation whose numbers nobody needs (scipy.sparse.linalg.spilu).
_SYMMETRIC_ORDER = {
    "ILU_DropTol": 1.0,
    "ILU_FillFactor": 1.0,
    "ColPerm": "MMD_AT_PLUS_A",
    "DiagPivotThresh": 0.0,
    "SymmetricMode": True,
}


def minimum_degree(pattern: BlockPattern) -> I64:
    """Return the order (num_nodes,): entry k is the node that is eliminated as number k."""
    graph = QuotientGraph.of(pattern)
    return graph.order_of_nodes(minimum_degree_of_groups(graph))


def minimum_degree_of_groups(graph: QuotientGraph) -> I64:
    """Return the order (groups,) by SuperLU's multiple minimum degree."""
    if len(graph.rows) == 0:
        return np.arange(len(graph))
    start, neighbours = graph.adjacency(has_diagonal=True)
    column = np.repeat(np.arange(len(graph), dtype=np.int32), np.diff(start))
    # the diagonal must dominate by far
    entries = np.where(neighbours == column, 1e6 * (len(graph.rows) + 1.0), 1.0)
    del column
    factors = _factors(entries, neighbours, start)
    return np.argsort(factors.perm_c).astype(np.int64)


def _factors(entries: F64, rows: I32, start: I32) -> Any:
    """Return SuperLU's factors of a matrix of columns; without scipy's packages, whose import takes 0.2 s."""
    size = len(start) - 1
    try:
        return scipy_extension("sparse.linalg._dsolve._superlu").gstrf(
            size,
            len(entries),
            entries,
            rows,
            start,
            csc_construct_func=tuple,  # makes the factors when they are asked for
            ilu=True,
            options=_SYMMETRIC_ORDER,
        )
    except (ImportError, AttributeError, TypeError):  # another version of scipy
        from scipy.sparse import csc_matrix
        from scipy.sparse.linalg import spilu

        matrix = csc_matrix((entries, rows, start), shape=(size, size))
        return spilu(matrix, options=_SYMMETRIC_ORDER)


__all__ = [
    "AUTOMATIC",
    "Ordering",
    "OrderingKind",
    "indistinguishable_nodes",
    "minimum_degree",
]

_WORTH_ANOTHER = 2e9
"""Operations of a factorisation, a tenth of a second, from which a second order is worth its time."""


class OrderingKind(Enum):
    """Algorithms that order the nodes."""

    AUTO = "auto"
    MINIMUM_DEGREE = "minimum_degree"
    NESTED_DISSECTION = "nested_dissection"


@dataclasses.dataclass(frozen=True, eq=False)
class Ordering:
    """Orders the nodes of a pattern."""

    # algorithm; AUTO takes the order of fewer predicted operations
    kind: OrderingKind = OrderingKind.AUTO
    # position (num_nodes, 3) of every node, not-a-number = none: nested dissection cuts there where METIS is
    # not installed
    position_m: F64 | None = None

    def __call__(self, pattern: BlockPattern) -> I64:
        """Return the order (num_nodes,): entry k is the node that is eliminated as number k.

        Raises:
            FlagError: Nested dissection is asked for, and neither METIS nor positions are there.
        """
        graph = QuotientGraph.of(pattern)
        return graph.order_of_nodes(self._order(graph, pattern.node_size))

    def _order(self, graph: QuotientGraph, node_size: int) -> I64:
        """Return the order (groups,)."""
        if self.kind is OrderingKind.NESTED_DISSECTION:
            return self._nested_dissection(graph)
        first = minimum_degree_of_groups(graph)
        if self.kind is OrderingKind.MINIMUM_DEGREE:
            return first
        work = graph.work(first, node_size)
        if work < _WORTH_ANOTHER or not self._can_dissect:
            return first
        second = self._nested_dissection(graph)
        return second if graph.work(second, node_size) < work else first

    @property
    def _can_dissect(self) -> bool:
        return self.position_m is not None or has_metis()

    def _nested_dissection(self, graph: QuotientGraph) -> I64:
        if has_metis():
            return dissect_by_metis(graph)
        if self.position_m is None:
            raise FlagError("nested dissection needs METIS here: pip install pymetis")
        return dissect_by_position(graph, self.position_m)


AUTOMATIC = Ordering()
