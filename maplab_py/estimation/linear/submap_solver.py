"""Block-sparse Cholesky in bounded memory: part by part, finished panels in a temporary file.

The factor is that of `supernodal_solver` for the same order of nodes, to the last bit of every sum that a
part has to itself. In memory are the panels of a submap and of the separators above it.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import block_storage, dense_kernels, pattern, protocol, supernodal
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.single_solve import solve_backwards, solve_forwards
from maplab_py.estimation.linear.symbolic import FrontPlan, SymbolicFactor, analyse, most_below
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.memory import require_memory
from maplab_py.vimap.table import starts_of_counts

# Nested dissection puts the nodes that hold the graph together at the top of the elimination tree. Without
# them the tree falls into two halves that share no block of the matrix, and so do the halves in turn: a
# binary tree of separators with submaps as its leaves. A submap marks the separators above it alone.
# When the submaps are eliminated one after another, and each separator after what lies below it, only the
# panels on one path from a submap to the root have to be in memory.
#
# The submap whose path is largest is halved until there are as many as wanted or its path shrinks no more.

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
        starts_of_counts(np.array([len(part) for part in members], dtype=np.int64)),
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
    first_node = starts_of_counts(width[order])
    nodes = _ranges(plan.first_node[order], width[order])  # old position of every new one
    position = np.empty(len(nodes), dtype=np.int64)
    position[nodes] = np.arange(len(nodes))
    rows = _ranges(plan.below_start[order], below[order])
    above = plan.parent[order]
    return FrontPlan(
        node_size=d,
        order=plan.order[nodes],
        first_node=first_node,
        below_start=starts_of_counts(below[order]),
        below=position[plan.below[rows]],
        below_in_parent=plan.below_in_parent[rows],
        parent=np.where(above >= 0, new_of[above], -1),
        panel_start=starts_of_counts(((width + below) * width * d * d)[order]),
    )


def _ranges(first: I64, counts: I64) -> I64:
    """Return first[i] .. first[i] + counts[i] - 1 of every i, one after another."""
    start = starts_of_counts(counts)
    return np.arange(start[-1]) + np.repeat(first - start[:-1], counts)


_BYTES = 8


class SubmapCholesky:
    """Solves A x = b for one right side, with a submap and the separators above it in memory.

    A pass is `start`, then for every part, a submap or a separator, `select`, additions to its blocks
    and right side, and `eliminate`; then `solve`. Blocks between a part and the separators above it
    belong to the part.
    """

    def __init__(
        self,
        rows: I32,
        cols: I32,
        num_nodes: int,
        node_size: int,
        count: int,
        ordering: Callable[[pattern.BlockPattern], I64] = AUTOMATIC,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """Analyse the structure of the lower blocks at rows and cols, each (B,).

        Args:
            rows: Block rows.
            cols: Block columns.
            num_nodes: Block rows of the matrix.
            node_size: Rows of a block.
            count: Largest number of submaps.
            ordering: Orders the nodes.
            tell: Shows what is in memory and what is on disk.

        Raises:
            NotEnoughMemory: A submap with the separators above it does not fit.
        """
        symbolic = analyse(pattern.BlockPattern.checked(rows, cols, num_nodes, node_size), ordering)
        self.statistics: protocol.FactorStatistics = symbolic.statistics
        self.submaps = cut_into_submaps(symbolic, count)
        self.plan = self.submaps.plan
        self.count = sum(self.submaps.is_submap)
        self.node_part = self.submaps.part_of_nodes()
        widest_update = (most_below(self.plan) * node_size) ** 2
        self._scratch = np.empty(min(supernodal.SCRATCH_SIZE, widest_update))
        held = _BYTES * (self.submaps.room + len(self._scratch))
        if tell is not None:
            tell(
                f"linear solver: {self.count} submaps, {1e-9 * held:.2f} GB of a factor of "
                f"{1e-9 * _BYTES * symbolic.statistics.nonzeros:.2f} GB in memory, the rest in "
                f"{tempfile.gettempdir()}"
            )
        require_memory(held, f"the largest submap of {num_nodes * node_size} unknowns")
        self.numbers = np.empty(self.submaps.room)
        position, column_start, leading = block_storage.layout_of_panels(self.plan)
        shift = self.submaps.offset - self.plan.panel_start[self.submaps.start[:-1]]
        self.layout = block_storage.BlockLayout(
            node_size, position, column_start + shift[self.node_part], leading
        )
        self._begins = [self.submaps.begins_with(part) for part in range(len(self.submaps))]
        self._blas = dense_kernels.Blas.workspace()
        self._file: Any = tempfile.TemporaryFile(prefix="maplab-submaps-", buffering=0)  # noqa: SIM115
        self._x = np.zeros(num_nodes * node_size)  # in elimination order
        self.select(0)

    def places(self, rows: I32, cols: I32) -> I32:
        """Return what `add` needs to know about blocks (B,) of the pattern."""
        return np.asarray(block_storage.panel_places(self.plan, self.layout.position, rows, cols))

    def start(self) -> None:
        """Set the right side to zero; parts are when they are selected."""
        self._x[:] = 0.0

    def select(self, part: int) -> None:
        """Make a part the one that is added to and eliminated, in the order of the parts.

        Whatever nothing was added to before is set to zero.
        """
        self._place(part)
        for fresh in self._begins[part]:
            first = int(self.submaps.offset[fresh])
            self.numbers[first : first + self.submaps.size_of(fresh)] = 0.0

    def _place(self, part: int) -> None:
        """Let the panels of a part, and of the separators above it, be found in memory."""
        self._selected, base = part, self.plan.panel_start
        panel_start = base.copy()
        for held in self.submaps.path(part):
            first, end = self.submaps.range_of(held)
            panel_start[first : end + 1] = base[first : end + 1] + (
                self.submaps.offset[held] - base[first]
            )
        self._placed = self.plan._replace(panel_start=panel_start)

    def add(self, rows: I32, cols: I32, places: I32, values: F64) -> None:
        """Add blocks (B, d, d) at block rows and columns (B,) of the selected part."""
        block_storage.add_blocks(self.layout, rows, cols, places, values, self.numbers)

    def add_to_diagonal(self, nodes: I64, added: F64) -> None:
        """Add numbers (k, d) to the diagonal at nodes (k,) of the selected part."""
        d = self.plan.node_size
        short = nodes.astype(np.int32)
        start = self.layout.column_start[nodes] + self.places(short, short)
        step = np.arange(d) * (self.layout.leading[nodes, None] + 1)
        self.numbers[start[:, None] + step] += added

    def add_to_right_side(self, nodes: I64, added: F64) -> None:
        """Add numbers (k, d) to the right side at nodes (k,)."""
        rows = self.layout.position[nodes]
        self._x.reshape(-1, self.plan.node_size)[rows] += added

    def project(self, is_restricted: Mask, projector: F64, size: F64) -> None:
        """Turn the selected part A into P A P + s (I - P); see `project_panels`."""
        inner = self.submaps.range_of(self._selected)
        block_storage.project_panels(
            self._placed, is_restricted, projector, size, self.numbers, *inner
        )

    def eliminate(self) -> None:
        """Eliminate the selected part: the separators above get what it leaves, the file its factor.

        Raises:
            NotPositiveDefinite: A pivot is not positive (or not a number).
            EstimationError: The file cannot be written.
        """
        inner = self.submaps.range_of(self._selected)
        with single_blas_thread():
            bad = supernodal.factorise(
                self._placed, self.numbers, self._scratch, self._blas, *inner
            )
            if bad >= 0:
                raise protocol.NotPositiveDefinite(int(self.plan.order[bad]))
            solve_forwards(self._placed, self.numbers, self._x, *inner)
        if self._selected + 1 < len(self.submaps):
            self._keep()

    def solve(self) -> F64:
        """Return x (nodes, d) when all parts have been eliminated.

        Raises:
            EstimationError: The file cannot be read.
        """
        with single_blas_thread():
            for part in range(len(self.submaps) - 1, -1, -1):
                self._place(part)
                if part + 1 < len(self.submaps):
                    self._fetch()
                inner = self.submaps.range_of(part)
                solve_backwards(self._placed, self.numbers, self._x, *inner)
        x = self._x.reshape(-1, self.plan.node_size)
        return np.asarray(x[self.layout.position])

    def _panels(self) -> memoryview:
        """Return the bytes of the selected part's panels, and go to their place in the file."""
        first, _ = self.submaps.range_of(self._selected)
        begin, size = int(self.submaps.offset[self._selected]), self.submaps.size_of(self._selected)
        self._file.seek(_BYTES * int(self.plan.panel_start[first]))
        return self.numbers[begin : begin + size].data.cast("B")

    def _keep(self) -> None:
        try:
            left = self._panels()
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise _file_error(error) from error

    def _fetch(self) -> None:
        try:
            left = self._panels()
            while left:
                count = self._file.readinto(left)
                if not count:
                    raise OSError(0, "it is truncated")
                left = left[count:]
        except OSError as error:
            raise _file_error(error) from error


def _file_error(error: OSError) -> EstimationError:
    return EstimationError(
        f"the factor of a submap cannot be kept in {tempfile.gettempdir()} ({error.strerror}): free "
        "space there, or name another folder by TMPDIR"
    )
