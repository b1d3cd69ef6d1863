"""Preconditioner of the iterative solver: an exact factor of everything but shared landmarks.

    M = all terms that are not visual + the 6 x 6 diagonal blocks of the visual Schur complement
        + the damping

Both parts are positive semidefinite by construction, so no shift or scaling is needed. The
inertial chain, whose stiffness ruins block-Jacobi, is solved exactly; the iterations only solve for
the coupling of poses by landmarks.

Edges between distant vertices, such as loop closures, would fill the factor. Only the diagonal blocks
of their vertices are used, unless an edge is the only connection of two parts of the graph.
"""

from collections.abc import Sequence

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.estimation.linear.block_cholesky import BlockCholesky
from maplab_py.estimation.states import NODES_PER_VERTEX, ORIENTATION, POSITION, States
from maplab_py.estimation.terms import factor as factor_terms

_NEAR = 8
"""Vertices whose rows differ by no more are near: what joins them adds a band to the factor."""


class Preconditioner:
    """Factorised M; `factor` may be called any number of times."""

    def __init__(self, states: States, factor_nodes: Sequence[I64], has_visual: bool) -> None:
        """Analyse M for states of this layout.

        Args:
            states: Layout of the nodes.
            factor_nodes: Nodes (N, n) of every term that is not visual.
            has_visual: Whether there are diagonal blocks of visual terms.

        Raises:
            NotEnoughMemory: The factor does not fit.
        """
        vertices = len(states.T_G_I) if has_visual else 0
        first = NODES_PER_VERTEX * np.arange(vertices, dtype=np.int64)[:, None]
        every = np.arange(states.num_nodes, dtype=np.int64)
        row = first + np.array([POSITION, ORIENTATION, ORIENTATION])
        col = first + np.array([POSITION, POSITION, ORIENTATION])
        places = [(every, every), (row.reshape(-1), col.reshape(-1))]
        self._kept = _exact_blocks(factor_nodes, len(states.T_G_I))
        for nodes, kept in zip(factor_nodes, self._kept, strict=True):
            factor_row, factor_col = factor_terms.block_places(nodes)
            places.append((factor_row[kept], factor_col[kept]))
        self._rows, self._cols = (np.concatenate(part) for part in zip(*places, strict=True))
        self._solver = BlockCholesky(self._rows, self._cols, states.num_nodes, 3)

    def factor(
        self, added: F64, pose_blocks: F64, factor_blocks: Sequence[F64], projector: F64, size: F64
    ) -> None:
        """Factorise M, restricted to the directions that may move.

        Args:
            added: Damping (nodes, 3).
            pose_blocks: Diagonal blocks (V, 6, 6) of the visual terms; none without such terms.
            factor_blocks: Blocks (N n (n + 1) / 2, 3, 3) of every other term.
            projector: Projectors (nodes, 3, 3).
            size: Pivots (nodes,) of directions that must not move.

        Raises:
            NotPositiveDefinite: M is singular.
        """
        lower = [pose_blocks[:, :3, :3], pose_blocks[:, 3:, :3], pose_blocks[:, 3:, 3:]]
        values = np.concatenate(
            [
                added[:, :, None] * np.eye(3),
                np.stack(lower, axis=1).reshape(-1, 3, 3),
                *(blocks[kept] for blocks, kept in zip(factor_blocks, self._kept, strict=True)),
            ]
        )
        is_restricted = (projector != np.eye(3)).any(axis=(1, 2))
        touched = np.flatnonzero(is_restricted[self._rows] | is_restricted[self._cols])
        left, right = projector[self._rows[touched]], projector[self._cols[touched]]
        values[touched] = left @ values[touched] @ right
        held = np.flatnonzero(is_restricted)
        values[held] += size[held, None, None] * (np.eye(3) - projector[held])
        self._solver.factor(values)

    def apply(self, residual: F64) -> F64:
        """Return M^-1 r for r (nodes, 3)."""
        return self._solver.solve(residual.reshape(-1)).reshape(-1, 3)


def _exact_blocks(factor_nodes: Sequence[I64], num_vertices: int) -> list[Mask]:
    """Tell of the blocks (N n (n + 1) / 2,) of every term which ones M has."""
    low, high = (
        (
            np.concatenate([np.zeros(0, dtype=np.int64), *part])
            for part in zip(*(_ends(nodes, num_vertices) for nodes in factor_nodes), strict=True)
        )
        if factor_nodes
        else (np.zeros(0, dtype=np.int64),) * 2
    )
    is_exact = (high - low <= _NEAR) | _joins_parts(low, high, num_vertices)
    masks, start = [], 0
    for nodes in factor_nodes:
        exact = is_exact[start : start + len(nodes)]
        start += len(nodes)
        b, a = np.tril_indices(nodes.shape[1])
        group = np.where(
            nodes < NODES_PER_VERTEX * num_vertices,
            nodes // NODES_PER_VERTEX,
            nodes + num_vertices,
        )
        masks.append((exact[:, None] | (group[:, b] == group[:, a])).reshape(-1))
    return masks


def _ends(nodes: I64, num_vertices: int) -> tuple[I64, I64]:
    """Return the first and last vertex (N,) that factors touch; 0 and 0 where they touch none."""
    vertex = nodes // NODES_PER_VERTEX
    is_vertex = vertex < num_vertices
    low = np.where(is_vertex, vertex, num_vertices).min(axis=1, initial=num_vertices)
    high = np.where(is_vertex, vertex, 0).max(axis=1, initial=0)
    return np.minimum(low, high), high


def _joins_parts(low: I64, high: I64, num_vertices: int) -> Mask:
    """Return which factors (N,) are edges of a spanning forest in which near ones come first.

    The others close a loop. A forest adds no fill.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    is_far = high - low > _NEAR
    if not is_far.any():
        return np.zeros(len(low), dtype=np.bool_)
    pairs = np.flatnonzero(high > low)
    key = low[pairs] * num_vertices + high[pairs]
    distinct, first = np.unique(key, return_index=True)
    rank = is_far[pairs[first]] * len(low) + first + 1.0  # near before far, then as they come
    ends = (distinct // num_vertices, distinct % num_vertices)
    graph = coo_array((rank, ends), shape=(num_vertices, num_vertices)).tocsr()
    forest = minimum_spanning_tree(graph).tocoo()
    in_forest = forest.row.astype(np.int64) * num_vertices + forest.col
    return np.isin(low * num_vertices + high, in_forest)
