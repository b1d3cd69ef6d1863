"""Storage of the blocks of a symmetric matrix: they are summed in the storage that is factorised.

A block (row, col) of d x d numbers lies in the columns of the node that is eliminated first, transposed
where that is its row. Columns follow each other, `leading` numbers apart, so that the block's number
(r, c) is at `column_start[node] + place + c * leading[node] + r`. Only places, 32 bits a block, have to be
kept to add the blocks again.
"""

from typing import NamedTuple

import numpy as np

from maplab_py.array_types import F64, I32, I64, Mask
from maplab_py.compilation import compiled
from maplab_py.estimation.linear.blocks_of_six import add_block, add_transposed
from maplab_py.estimation.linear.symbolic import FrontPlan


class BlockLayout(NamedTuple):
    """Layout of the columns of n nodes."""

    node_size: int
    position: I64  # (n,) place in the elimination order
    column_start: I64  # (n,) offset of the first number of the node's first column
    leading: I64  # (n,) numbers from one column to the next


@compiled()
def layout_of_panels(plan: FrontPlan) -> tuple[I64, I64, I64]:
    """Return position, start of the columns and leading dimension of every node (n,)."""
    n, d = len(plan.order), plan.node_size
    position, column_start = np.empty(n, np.int64), np.empty(n, np.int64)
    leading = np.empty(n, np.int64)
    for s in range(len(plan.parent)):
        first, end = plan.first_node[s], plan.first_node[s + 1]
        height = (end - first + plan.below_start[s + 1] - plan.below_start[s]) * d
        for k in range(first, end):
            node = plan.order[k]
            position[node] = k
            column_start[node] = plan.panel_start[s] + (k - first) * d * height
            leading[node] = height
    return position, column_start, leading


@compiled()
def panel_places(plan: FrontPlan, position: I64, rows: I32, cols: I32) -> I32:
    """Return the places (B,) of blocks in the panels of their supernodes.

    Args:
        plan: Structure; every block must be in it.
        position: Place (n,) of every node in the elimination order.
        rows: Block rows (B,).
        cols: Block columns (B,).
    """
    supernode = np.empty(len(position), np.int32)
    for s in range(len(plan.parent)):
        supernode[plan.first_node[s] : plan.first_node[s + 1]] = s
    places = np.empty(len(rows), np.int32)
    for block in range(len(rows)):
        i, j = position[rows[block]], position[cols[block]]
        low, high = min(i, j), max(i, j)
        s = supernode[low]
        first, end = plan.first_node[s], plan.first_node[s + 1]
        local = high - first
        if high >= end:
            below = plan.below[plan.below_start[s] : plan.below_start[s + 1]]
            local = end - first + np.searchsorted(below, high)
        places[block] = local * plan.node_size
    return places


@compiled()
def add_blocks(
    layout: BlockLayout, rows: I32, cols: I32, places: I32, values: F64, numbers: F64
) -> None:
    """Add blocks (B, d, d) to the numbers of the storage, one after another."""
    d = layout.node_size
    if d == 6:
        _add_blocks_of_six(layout, rows, cols, places, values, numbers.reshape(-1, 6))
        return
    for block in range(len(rows)):
        row, col = rows[block], cols[block]
        if layout.position[row] >= layout.position[col]:
            start, leading = layout.column_start[col] + places[block], layout.leading[col]
            for c in range(d):
                for r in range(d):
                    numbers[start + c * leading + r] += values[block, r, c]
        else:
            start, leading = layout.column_start[row] + places[block], layout.leading[row]
            for c in range(d):
                for r in range(d):
                    numbers[start + c * leading + r] += values[block, c, r]


@compiled()
def _add_blocks_of_six(
    layout: BlockLayout, rows: I32, cols: I32, places: I32, values: F64, numbers: F64
) -> None:
    for block in range(len(rows)):
        row, col = rows[block], cols[block]
        is_lower = layout.position[row] >= layout.position[col]
        node = col if is_lower else row
        at, leading = (layout.column_start[node] + places[block]) // 6, layout.leading[node] // 6
        if is_lower:
            add_block(numbers, at, leading, values, block)
        else:
            add_transposed(numbers, at, leading, values, block)


@compiled()
def read_blocks(layout: BlockLayout, rows: I32, cols: I32, places: I32, numbers: F64) -> F64:
    """Return the numbers of blocks as (B, d, d)."""
    d = layout.node_size
    values = np.empty((len(rows), d, d))
    for block in range(len(rows)):
        row, col = rows[block], cols[block]
        is_transposed = layout.position[row] < layout.position[col]
        node = row if is_transposed else col
        start, leading = layout.column_start[node] + places[block], layout.leading[node]
        for c in range(d):
            for r in range(d):
                if is_transposed:
                    values[block, c, r] = numbers[start + c * leading + r]
                else:
                    values[block, r, c] = numbers[start + c * leading + r]
    return values


@compiled()
def add_to_diagonal(layout: BlockLayout, places: I32, added: F64, numbers: F64) -> None:
    """Add numbers (n, d) to the diagonal; places (n,) are those of the diagonal blocks."""
    for node in range(len(places)):
        start = layout.column_start[node] + places[node]
        for c in range(layout.node_size):
            numbers[start + c * (layout.leading[node] + 1)] += added[node, c]


@compiled()
def project_panels(
    plan: FrontPlan, is_restricted: Mask, projector: F64, size: F64, numbers: F64
) -> None:
    """Turn the stored matrix A into P A P + s (I - P), in place.

    Args:
        plan: Structure.
        is_restricted: Whether the projector of a node (n,) is not the identity.
        projector: Symmetric projectors (n, d, d).
        size: Pivots s (n,) of the directions that are projected away.
        numbers: Panels.
    """
    d = plan.node_size
    room = np.empty(len(plan.order), np.int64)
    work = np.empty((2, d, d))
    for s in range(len(plan.parent)):
        first, end = plan.first_node[s], plan.first_node[s + 1]
        width, below = end - first, plan.below_start[s + 1] - plan.below_start[s]
        panel = numbers[plan.panel_start[s] : plan.panel_start[s + 1]].reshape(width * d, -1)
        count = 0  # of restricted rows
        for local in range(width + below):
            if is_restricted[_node(plan, s, local)]:
                room[count] = local
                count += 1
        for col in range(width):
            node = plan.order[first + col]
            if is_restricted[node]:
                for local in range(col, width + below):
                    row = _node(plan, s, local)
                    _project_block(panel, local * d, col * d, projector[row], projector[node], work)
                for r in range(d):
                    for c in range(d):
                        kept = (1.0 if r == c else 0.0) - projector[node, r, c]
                        panel[col * d + c, col * d + r] += size[node] * kept
            else:
                for local in room[:count]:
                    if local > col:
                        row = _node(plan, s, local)
                        _project_block(
                            panel, local * d, col * d, projector[row], projector[node], work
                        )


@compiled()
def _node(plan: FrontPlan, s: int, local: int) -> int:
    """Return the node that is a local node of a front."""
    width = plan.first_node[s + 1] - plan.first_node[s]
    if local < width:
        return plan.order[plan.first_node[s] + local]  # type: ignore[no-any-return]
    return plan.order[plan.below[plan.below_start[s] + local - width]]  # type: ignore[no-any-return]


@compiled()
def _project_block(panel: F64, row: int, col: int, left: F64, right: F64, work: F64) -> None:
    """Overwrite the block B at a row and column of a panel[column, row] by left B right.

    Of a block on the diagonal only the lower triangle is read. `work` (2, d, d) is room.
    """
    d = len(left)
    block, product = work[0], work[1]
    for r in range(d):
        for c in range(d):
            is_upper = row == col and c > r
            block[r, c] = panel[col + r, row + c] if is_upper else panel[col + c, row + r]
    for r in range(d):
        for c in range(d):
            total = 0.0
            for k in range(d):
                total += left[r, k] * block[k, c]
            product[r, c] = total
    for r in range(d):
        for c in range(d):
            total = 0.0
            for k in range(d):
                total += product[r, k] * right[k, c]
            panel[col + c, row + r] = total
