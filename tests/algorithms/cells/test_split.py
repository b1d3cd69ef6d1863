"""Cells: every vertex and observation is in one, cells are valid maps, wrong numbers are refused."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.cells.cells import split_by_position
from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.errors import FlagError, UserError
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import simulated


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_cells_cover_the_map_and_are_valid(count: int) -> None:
    first, second = simulated().maps
    vi_map = merge_maps(first, second)[0]
    cells = split_by_position(vi_map, CellOptions(count=count, overlap_m=0.0))
    assert len(cells) == count
    ids = [vertex for cell in cells for vertex in to_hex_list(cell.vertices.id)]
    assert sorted(ids) == sorted(to_hex_list(vi_map.vertices.id))
    assert sum(len(cell.observations) for cell in cells) == len(vi_map.observations)
    sizes = [len(cell.vertices) for cell in cells]
    assert max(sizes) - min(sizes) <= 2
    for cell in cells:
        assert check_consistency(cell).failure == ""
        rows = vi_map.vertex_index.rows(cell.vertices.id)
        np.testing.assert_allclose(cell.T_G_I, vi_map.T_G_I[rows], atol=1e-12)
        rows = vi_map.landmark_index.rows(cell.landmarks.id)
        np.testing.assert_allclose(cell.p_G, vi_map.p_G[rows], atol=1e-9)


def test_overlap_adds_what_is_near() -> None:
    vi_map = simulated().maps[0]
    sizes = []
    for overlap_m in (0.0, 0.5, 100.0):
        cells = split_by_position(vi_map, CellOptions(count=2, overlap_m=overlap_m))
        sizes.append(sum(len(cell.vertices) for cell in cells))
    assert len(vi_map.vertices) == sizes[0] < sizes[1] < sizes[2] == 2 * len(vi_map.vertices)


def test_wrong_numbers_are_refused() -> None:
    with pytest.raises(FlagError, match="--cell_count=0"):
        CellOptions(count=0)
    for overlap_m in (-1.0, float("inf")):
        with pytest.raises(FlagError, match="--cell_overlap_m"):
            CellOptions(overlap_m=overlap_m)
    with pytest.raises(UserError, match=r"the map has only .* ask for fewer cells"):
        split_by_position(simulated().maps[0], CellOptions(count=10_000))
