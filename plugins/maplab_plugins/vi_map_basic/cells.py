"""Splitting a map into cells, and joining them again."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.plugin import CommandContext, Report, UserError, command

if TYPE_CHECKING:
    from maplab_py.algorithms.cells.cells import JoinReport


@dataclasses.dataclass(frozen=True)
class CellLine:
    """One cell of a map."""

    map_key: str
    missions: int
    vertices: int
    landmarks: int


class SplitReport(Report):
    """The cells of a map, each a new map in memory."""

    cells: tuple[CellLine, ...] = dataclasses.field(metadata={"title": ""})


@command(
    "split_map",
    example="split_map --cell_count=2 --cell_overlap_m=2",
    see_also=("join_submaps", "save_all", "generate_summary_map_and_save_to_disk"),
)
def split_map(context: CommandContext, *, options: CellOptions = CellOptions()) -> SplitReport:
    """Split the selected map by position into overlapping cells, each a new map in memory.

    The cells are named after the map: office_cell_0, office_cell_1, ... The map itself stays and is
    still selected. A vertex in the overlap has the same id in all its cells.
    """
    from maplab_py.algorithms.cells.cells import split_by_position

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


@command(
    "join_submaps",
    example="join_submaps --target_map_key=city --map_keys=city_cell_0,city_cell_1",
    see_also=("split_map", "compare_maps", "merge_map", "load_merge_all_submaps"),
    needs_map=False,
)
def join_submaps(
    context: CommandContext, target_map_key: str, *, map_keys: str = "", keep_submaps: bool = False
) -> JoinReport:
    """Join cells that were edited apart to one map, which is selected; the cells are removed from memory.

    Vertices, landmarks and edges with one id become one. Where cells differ, the copy of a vertex is taken
    from the cell where it is farthest from what the cell lacks, with its images and observations. What only
    one cell has stays: an entity is removed only if all cells that had it have removed it.

    Args:
        target_map_key: Key of the new map.
        map_keys: Keys of the cells, separated by commas; empty = all maps in memory that are named after the
            target, as split_map names them (city_cell_0, city_cell_1, ...).
        keep_submaps: Keep the cells in memory.
    """
    from maplab_py.algorithms.cells.cells import join_cells

    keys = [key.strip() for key in map_keys.split(",") if key.strip()]
    if not map_keys:
        named = [key for key in context.maps.keys if _is_cell_of(key, target_map_key)]
        keys = sorted(named, key=lambda key: int(key.rpartition("_")[2]))
    if len(keys) < 2:
        raise UserError(
            f"join_submaps: needs two or more cells, found {', '.join(keys) or 'none'}: "
            "name them by --map_keys"
        )
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise UserError(f"join_submaps: --map_keys names '{twice[0]}' twice")
    if keep_submaps or target_map_key not in keys:
        context.maps.check_new_key(target_map_key)
    entries = [context.maps.get(key) for key in keys]
    joined, report = join_cells([entry.vi_map for entry in entries], progress=context.progress)
    if not keep_submaps:
        for key in keys:
            context.maps.remove(key)
    context.maps.add(target_map_key, joined)
    return report


def _is_cell_of(key: str, map_key: str) -> bool:
    number = key.removeprefix(f"{map_key}_cell_")
    return number != key and number.isdecimal()
