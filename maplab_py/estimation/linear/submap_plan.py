"""Submaps of a factorisation: parts of the elimination tree that need not be in memory together.

Nested dissection puts the nodes that hold the graph together at the top of the elimination tree. Without
them the tree falls into two halves that share no block of the matrix, and so do the halves in turn: a binary
tree of separators with submaps as its leaves. A submap leaves its mark on the separators above it alone.
When the submaps are eliminated one after another, and each separator after what lies below it, only the
panels on one path from a submap to the root have to be in memory.

The submap whose path is largest is halved until there are as many as wanted or its path shrinks no more.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.estimation.linear.symbolic import FrontPlan, SymbolicFactor

_LARGEST_HALF = 0.65
"""Share of what is halved that the larger half may have."""
_NO_PART = -1


@dataclasses.dataclass(frozen=True, eq=False)
class SubmapPlan:
    """A plan whose supernodes come part by part: submaps and separators, each after what lies below it."""

    plan: FrontPlan  # panels lie as if all were in memory
    start: I64  # (P + 1,) first supernode of every part
    above: I64  # (P,) the separator above every part, -1 = none
    is_submap: tuple[bool, ...]  # whether a part is a submap, not a separator
    offset: I64  # (P,) place of the first number of every part in memory
    room: int  # numbers in memory

    def __len__(self) -> int:
        return len(self.above)

    def range_of(self, part: int) -> tuple[int, int]:
        """Return the first supernode of a part and the one after its last."""
        return int(self.start[part]), int(self.start[part + 1])

    def size_of(self, part: int) -> int:
        """Return the numbers of the panels of a part."""
        first, end = self.range_of(part)
        return int(self.plan.panel_start[end] - self.plan.panel_start[first])

    def path(self, part: int) -> list[int]:
        """Return a part and the separators above it."""
        parts = [part]
        while self.above[parts[-1]] >= 0:
            parts.append(int(self.above[parts[-1]]))
        return parts

    def begins_with(self, part: int) -> list[int]:
        """Return the parts that nothing was added to before a part is eliminated."""
        return [p for p in self.path(part) if self._first_below(p) == part]

    def part_of_nodes(self) -> I64:
        """Return the part of every node (n,)."""
        plan = self.plan
        result = np.empty(len(plan.order), dtype=np.int64)
        result[plan.order] = np.repeat(np.arange(len(self)), np.diff(plan.first_node[self.start]))
        return result

    def _first_below(self, part: int) -> int:
        """Return the first part of those that end in a part; the parts of a subtree follow each other."""
        first = part
        while first > 0 and part in self.path(first - 1):
            first -= 1
        return first


@dataclasses.dataclass(eq=False)
class _Part:
    """A part while it is cut: its supernodes, or the roots of the subtrees that it consists of."""

    above: _Part | None
    roots: list[int]  # of subtrees; of a separator its supernodes
    size: float
    is_submap: bool = True
    below: list[_Part] = dataclasses.field(default_factory=list)

    def path_size(self) -> float:
        """Return the numbers of the part and of the separators above it."""
        return self.size + (self.above.path_size() if self.above is not None else 0.0)


def cut_into_submaps(symbolic: SymbolicFactor, count: int) -> SubmapPlan:
    """Return at most `count` submaps, and separators, with which a factorisation needs least memory."""
    plan = symbolic.plan
    size = np.diff(plan.panel_start).astype(np.float64)
    cutter = _Cutter(plan.parent, size)
    whole = _Part(None, np.flatnonzero(plan.parent < 0).tolist(), float(size.sum()))
    tops, submaps = [whole], [whole]
    while len(submaps) < count:
        largest = max(submaps, key=_Part.path_size)
        halves = cutter.halve(largest)
        if not halves or max(map(_Part.path_size, halves)) >= largest.path_size():
            break
        submaps.remove(largest)
        submaps += halves
        top = halves[0].above if halves[0].above is not largest.above else None
        new = [top] if top is not None else halves
        siblings = tops if largest.above is None else largest.above.below
        siblings.remove(largest)
        siblings += new
    return _plan_of(plan, _postorder(tops), cutter)


class _Cutter:
    """Cuts sets of subtrees of the elimination tree in halves."""

    def __init__(self, parent: I64, size: F64) -> None:
        self.children: list[list[int]] = [[] for _ in range(len(parent))]
        self.total, self._size = size.copy(), size
        for s, above in enumerate(parent.tolist()):
            if above >= 0:
                self.children[above].append(s)
                self.total[above] += self.total[s]

    def halve(self, part: _Part) -> list[_Part]:
        """Return two submaps instead of one, below a new separator unless none is needed; [] = neither."""
        roots, cut = list(part.roots), list[int]()
        while roots:
            halves = self._halves(roots)
            sizes = [float(self.total[half].sum()) for half in halves]
            if max(sizes) <= _LARGEST_HALF * sum(sizes):
                separator = part.above
                if cut:
                    separator = _Part(
                        part.above, cut, float(self._size[cut].sum()), is_submap=False
                    )
                made = [_Part(separator, half, n) for half, n in zip(halves, sizes, strict=True)]
                if cut and separator is not None:
                    separator.below = list(made)
                return made
            largest = max(roots, key=self.total.__getitem__)
            roots.remove(largest)
            roots += self.children[largest]
            cut.append(largest)
        return []

    def _halves(self, roots: list[int]) -> list[list[int]]:
        """Share out subtrees, the largest first, each to the half that is smaller."""
        halves: list[list[int]] = [[], []]
        filled = [0.0, 0.0]
        for root in sorted(roots, key=lambda r: (-self.total[r], r)):
            smaller = int(filled[1] < filled[0])
            halves[smaller].append(root)
            filled[smaller] += self.total[root]
        return halves

    def supernodes(self, part: _Part) -> list[int]:
        """Return the supernodes of a part, children before their parents."""
        if not part.is_submap:
            return sorted(part.roots)
        stack, members = list(part.roots), []
        while stack:
            node = stack.pop()
            members.append(node)
            stack += self.children[node]
        return sorted(members)


def _postorder(tops: list[_Part]) -> list[_Part]:
    ordered: list[_Part] = []
    for part in tops:
        ordered += [*_postorder(part.below), part]
    return ordered


def _plan_of(plan: FrontPlan, parts: list[_Part], cutter: _Cutter) -> SubmapPlan:
    """Return the plan with supernodes in the order of the parts, and the place of each part in memory."""
    members = [cutter.supernodes(part) for part in parts]
    number = {id(part): k for k, part in enumerate(parts)}
    above = [_NO_PART if part.above is None else number[id(part.above)] for part in parts]
    room = int(max((part.path_size() for part in parts), default=0.0))
    offset = np.zeros(len(parts), dtype=np.int64)
    for k in range(len(parts) - 1, -1, -1):  # separators come after what lies below them
        end = room if above[k] < 0 else int(offset[above[k]])
        offset[k] = end - int(parts[k].size)
    order = np.array([s for part in members for s in part], dtype=np.int64)
    return SubmapPlan(
        _reordered(plan, order),
        _offsets(np.array([len(part) for part in members], dtype=np.int64)),
        np.array(above, dtype=np.int64),
        tuple(part.is_submap for part in parts),
        offset,
        room,
    )


def _reordered(plan: FrontPlan, order: I64) -> FrontPlan:
    """Return the plan with supernodes in another order that puts children before their parents.

    Nodes below a supernode are those of its ancestors, whose order among each other must not change.
    """
    d = plan.node_size
    width, below = np.diff(plan.first_node), np.diff(plan.below_start)
    new_of = np.empty(len(order), dtype=np.int64)
    new_of[order] = np.arange(len(order))
    first_node = _offsets(width[order])
    nodes = _ranges(plan.first_node[order], width[order])  # old position of every new one
    position = np.empty(len(nodes), dtype=np.int64)
    position[nodes] = np.arange(len(nodes))
    rows = _ranges(plan.below_start[order], below[order])
    above = plan.parent[order]
    return FrontPlan(
        node_size=d,
        order=plan.order[nodes],
        first_node=first_node,
        below_start=_offsets(below[order]),
        below=position[plan.below[rows]],
        below_in_parent=plan.below_in_parent[rows],
        parent=np.where(above >= 0, new_of[above], -1),
        panel_start=_offsets(((width + below) * width * d * d)[order]),
    )


def _offsets(counts: I64) -> I64:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _ranges(first: I64, counts: I64) -> I64:
    """Return first[i] .. first[i] + counts[i] - 1 of every i, one after another."""
    start = _offsets(counts)
    return np.arange(start[-1]) + np.repeat(first - start[:-1], counts)
