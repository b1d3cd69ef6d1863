"""Missions that stand still are tied."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.pose_graph_manipulation.edges import tie_stationary
from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import simulated

OPTIONS = StationaryOptions()


def standing(vi_map: VIMap, mission: int, moved_m: float) -> VIMap:
    """Let a mission stand still but for a small shift of its middle."""
    T_M_I = vi_map.vertices.T_M_I.copy()
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    T_M_I[rows] = T_M_I[rows[0]]
    T_M_I[rows[len(rows) // 2], 4] += moved_m
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))


def test_only_the_mission_that_stands_still_is_tied_and_only_once() -> None:
    both = standing(merge_maps(*simulated().maps)[0], 1, 0.05)
    tied, missions = tie_stationary(both, OPTIONS)
    assert missions == (to_hex(both.missions.id[1]),)
    edges = tied.loop_closure_edges
    rows = np.flatnonzero(both.vertices.mission == 1)
    assert (edges.from_vertex.tolist(), edges.to_vertex.tolist()) == ([rows[0]], [rows[-1]])
    assert np.array_equal(edges.T_A_B[0], se3.identity())
    assert check_consistency(tied).errors == ()
    again, _ = tie_stationary(tied, OPTIONS)
    assert len(again.loop_closure_edges) == 1


def test_a_mission_that_moves_in_between_is_not_tied() -> None:
    vi_map = simulated().maps[0]
    moved = standing(vi_map, 0, 0.15)
    assert tie_stationary(moved, OPTIONS) == (moved, ())
    assert tie_stationary(vi_map, OPTIONS) == (vi_map, ())
