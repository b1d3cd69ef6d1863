"""Block-sparse Cholesky in bounded memory: part by part, finished panels in a temporary file.

The factor is that of `supernodal_solver` for the same order of nodes, to the last bit of every sum that a
part has to itself. In memory are the panels of a submap and of the separators above it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.estimation.linear import supernodal
from maplab_py.estimation.linear.block_storage import (
    BlockLayout,
    add_blocks,
    layout_of_panels,
    panel_places,
    project_panels,
)
from maplab_py.estimation.linear.dense_kernels import Blas
from maplab_py.estimation.linear.ordering import AUTOMATIC
from maplab_py.estimation.linear.pattern import BlockPattern
from maplab_py.estimation.linear.protocol import FactorStatistics, NotPositiveDefinite
from maplab_py.estimation.linear.single_solve import solve_backwards, solve_forwards
from maplab_py.estimation.linear.submap_plan import cut_into_submaps
from maplab_py.estimation.linear.symbolic import analyse, most_below
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.memory import require_memory

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
        ordering: Callable[[BlockPattern], I64] = AUTOMATIC,
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
        symbolic = analyse(BlockPattern.checked(rows, cols, num_nodes, node_size), ordering)
        self.statistics: FactorStatistics = symbolic.statistics
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
        position, column_start, leading = layout_of_panels(self.plan)
        shift = self.submaps.offset - self.plan.panel_start[self.submaps.start[:-1]]
        self.layout = BlockLayout(
            node_size, position, column_start + shift[self.node_part], leading
        )
        self._begins = [self.submaps.begins_with(part) for part in range(len(self.submaps))]
        self._blas = Blas.workspace()
        self._file: Any = tempfile.TemporaryFile(prefix="maplab-submaps-", buffering=0)  # noqa: SIM115
        self._x = np.zeros(num_nodes * node_size)  # in elimination order
        self.select(0)

    def places(self, rows: I32, cols: I32) -> I32:
        """Return what `add` needs to know about blocks (B,) of the pattern."""
        return np.asarray(panel_places(self.plan, self.layout.position, rows, cols))

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
        add_blocks(self.layout, rows, cols, places, values, self.numbers)

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
        project_panels(self._placed, is_restricted, projector, size, self.numbers, *inner)

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
                raise NotPositiveDefinite(int(self.plan.order[bad]))
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
