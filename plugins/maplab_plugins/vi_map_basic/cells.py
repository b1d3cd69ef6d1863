"""Splitting a map into cells."""

from __future__ import annotations

import dataclasses

from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.plugin import CommandContext, Report, command


@dataclasses.dataclass(frozen=True)
class CellLine:
    """One cell of a map."""

    map_key: str
    missions: int
    vertices: int
    landmarks: int


@dataclasses.dataclass(frozen=True)
class SplitReport(Report):
    """The cells of a map, each a new map in memory."""

    cells: tuple[CellLine, ...] = dataclasses.field(metadata={"title": ""})


_CELLS = CellOptions()


@command(
    "split_map",
    example="split_map --cell_count=2 --cell_overlap_m=2",
    see_also=("save_all", "delete_map", "generate_summary_map_and_save_to_disk"),
)
def split_map(context: CommandContext, *, options: CellOptions = _CELLS) -> SplitReport:
    """Split the selected map by position into overlapping cells, each a new map in memory.

    The cells are named after the map: office_cell_0, office_cell_1, ... The map itself stays and is
    still selected. A vertex in the overlap has the same id in all its cells.
    """
    from maplab_py.algorithms.cells.split import split_by_position

    key = context.map_key
    cells = split_by_position(context.vi_map, options, progress=context.progress)
    keys = [context.maps.check_new_key(f"{key}_cell_{number}") for number in range(len(cells))]
    lines = []
    for cell_key, cell in zip(keys, cells, strict=True):
        context.maps.add(cell_key, cell)
        lines.append(
            CellLine(cell_key, len(cell.missions), len(cell.vertices), len(cell.landmarks))
        )
    context.maps.select(key)
    return SplitReport(tuple(lines))
