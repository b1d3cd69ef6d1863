"""Parameters beside vertices and landmarks: calibrations, switches, whatever a plugin adds.

A block holds N parameters of one kind. Every parameter is divided into nodes of three numbers, like
all other states in the normal equations; a vector of five numbers has two nodes, and the sixth
direction is padding that never changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from enum import Enum

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3, so3


class Manifold(Enum):
    """Kind of a parameter, which decides how a step moves it."""

    VECTOR = "vector"  # x + d
    POSE = "pose"  # [q p] (7); nodes position and orientation, as of vertices
    ROTATION = "rotation"  # [x y z w] (4); q Exp(d)


@dataclasses.dataclass(frozen=True, eq=False)
class ParameterBlock:
    """N parameters of one kind, values (N, size); a step never leaves [lower, upper]."""

    name: str
    values: F64
    manifold: Manifold = Manifold.VECTOR
    lower: float = -np.inf
    upper: float = np.inf

    def __len__(self) -> int:
        return len(self.values)

    @property
    def dimension(self) -> int:
        """Degrees of freedom of one parameter."""
        fixed = {Manifold.POSE: 6, Manifold.ROTATION: 3}
        return fixed.get(self.manifold, int(self.values.shape[1]))

    @property
    def nodes_each(self) -> int:
        """Nodes of one parameter."""
        return -(-self.dimension // 3)

    @property
    def num_nodes(self) -> int:
        """Nodes of all parameters."""
        return len(self) * self.nodes_each

    def moved(self, step: F64) -> ParameterBlock:
        """Apply a step (num_nodes, 3)."""
        by_parameter = step.reshape(len(self), -1)[:, : self.dimension]
        if self.manifold is Manifold.POSE:
            values = se3.retract(self.values, by_parameter)
        elif self.manifold is Manifold.ROTATION:
            values = so3.multiply(self.values, so3.exp(by_parameter))
        else:
            values = np.clip(self.values + by_parameter, self.lower, self.upper)
        return dataclasses.replace(self, values=values)

    def difference(self, reference: F64) -> F64:
        """Return the tangent vectors (N, dimension) that lead from a reference to the values."""
        if self.manifold is Manifold.POSE:
            q = so3.multiply(so3.inverse(reference[:, :4]), self.values[:, :4])
            return np.concatenate([self.values[:, 4:] - reference[:, 4:], so3.log(q)], axis=1)
        if self.manifold is Manifold.ROTATION:
            return so3.log(so3.multiply(so3.inverse(reference), self.values))
        return np.asarray(self.values - reference)


class ParameterBlocks:
    """Blocks by name with their place in the order of nodes. A value: steps make a new one."""

    def __init__(self, blocks: Iterable[ParameterBlock] = ()) -> None:
        """Put blocks one after another; names must differ."""
        self._blocks = {block.name: block for block in blocks}
        self._first: dict[str, int] = {}
        self.num_nodes = 0
        for block in self._blocks.values():
            self._first[block.name] = self.num_nodes
            self.num_nodes += block.num_nodes

    def __iter__(self) -> Iterator[ParameterBlock]:
        return iter(self._blocks.values())

    def __contains__(self, name: str) -> bool:
        return name in self._blocks

    def __getitem__(self, name: str) -> ParameterBlock:
        return self._blocks[name]

    def nodes(self, name: str, num_vertex_nodes: int) -> I64:
        """Return the nodes (N, nodes_each) of a block, which follow those of the vertices."""
        block = self._blocks[name]
        first = num_vertex_nodes + self._first[name]
        return first + np.arange(block.num_nodes, dtype=np.int64).reshape(len(block), -1)

    def padding(self, num_vertex_nodes: int) -> tuple[I64, F64]:
        """Return the nodes (k,) that hold padding, and projectors (k, 3, 3) that keep it still."""
        nodes, projectors = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3, 3))]
        for block in self:
            used = block.dimension % 3
            if used:
                last = self.nodes(block.name, num_vertex_nodes)[:, -1]
                nodes.append(last)
                kept = np.diag((np.arange(3) < used).astype(np.float64))
                projectors.append(np.tile(kept, (len(last), 1, 1)))
        return np.concatenate(nodes), np.concatenate(projectors)

    def moved(self, step: F64) -> ParameterBlocks:
        """Apply a step (num_nodes, 3)."""
        moved = []
        for block in self:
            first = self._first[block.name]
            moved.append(block.moved(step[first : first + block.num_nodes]))
        return ParameterBlocks(moved)

    def size2(self) -> float:
        """Return the squared norm of all values."""
        return float(sum(np.sum(block.values**2) for block in self))
