"""Cells of a map: every vertex is in one, cells are valid maps, and joined again they are the map."""

import numpy as np
import pytest

from maplab_py.algorithms.cells.cells import join_cells, split_by_position
from maplab_py.algorithms.cells.options import CellOptions
from maplab_py.algorithms.evaluation.map_comparison import compare_maps
from maplab_py.console.session.session import Session
from maplab_py.errors import FlagError, MapError, UserError
from maplab_py.geometry import se3
from maplab_py.vimap import LoopClosureEdges, VIMap, consistency, edits, merge, to_hex_list
from tests.simulation.small import simulated


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_cells_cover_the_map_and_are_valid(count: int) -> None:
    first, second = simulated().maps
    vi_map = merge.merge_maps(first, second)[0]
    cells = split_by_position(vi_map, CellOptions(count=count, overlap_m=0.0))
    assert len(cells) == count
    ids = [vertex for cell in cells for vertex in to_hex_list(cell.vertices.id)]
    assert sorted(ids) == sorted(to_hex_list(vi_map.vertices.id))
    assert sum(len(cell.observations) for cell in cells) == len(vi_map.observations)
    sizes = [len(cell.vertices) for cell in cells]
    assert max(sizes) - min(sizes) <= 2
    for cell in cells:
        assert consistency.check_consistency(cell).failure == ""
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


OVERLAP = CellOptions(count=3, overlap_m=0.6)


def sessions() -> VIMap:
    """Return two sessions with a loop closure edge between vertices that are far apart."""
    vi_map = merge.merge_maps(*simulated().maps)[0]
    first, last = 0, len(vi_map.vertices) - 1
    edge = LoopClosureEdges.filled(
        1,
        id=np.array([[7, 7]], dtype=np.uint64),
        from_vertex=[first],
        to_vertex=[last],
        T_A_B=se3.relative(vi_map.T_G_I[[first]], vi_map.T_G_I[[last]]),
    )
    return vi_map.replace(loop_closure_edges=edge)


def difference(a: VIMap, b: VIMap) -> list[str]:
    """Return what differs between two maps."""
    report = compare_maps(a, b)
    said = [row.what for row in report.rows if row.only_in_first or row.only_in_second]
    values = ("position_m", "rotation_deg", "landmark_position_m", "keypoint_px", "time_ns")
    said += [name for name in values if getattr(report, name).largest > 1e-9]
    if report.frames_with_other_keypoints or report.landmarks_of_other_quality:
        said.append("frames or landmarks")
    if report.descriptors_differing or report.sensors_differing:
        said.append("descriptors or sensors")
    return said


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("overlap_m", [1e-6, 0.6, 100.0])
def test_split_and_join_give_the_map_again(count: int, overlap_m: float) -> None:
    vi_map = sessions()
    cells = split_by_position(vi_map, CellOptions(count=count, overlap_m=overlap_m))
    joined, report = join_cells(cells)
    assert difference(vi_map, joined) == []
    assert consistency.check_consistency(joined).failure == ""
    assert report.vertices_shared == sum(len(c.vertices) for c in cells) - len(vi_map.vertices)
    assert report.vertices_differing == report.landmarks_united == 0
    rows = joined.vertex_index.rows(vi_map.vertices.id)
    for name in ("T_M_I", "v_M", "accel_bias", "gyro_bias", "timestamp_ns"):
        assert np.array_equal(getattr(joined.vertices, name)[rows], getattr(vi_map.vertices, name))
    edges, again = vi_map.imu_edges, joined.imu_edges
    assert np.array_equal(np.sort(again.sample_count), np.sort(edges.sample_count))
    assert len(joined.imu_samples) == len(vi_map.imu_samples)


def test_the_order_of_cells_does_not_change_what_is_joined() -> None:
    vi_map = sessions()
    cells = split_by_position(vi_map, OVERLAP)
    assert difference(vi_map, join_cells(cells[::-1])[0]) == []


def moved(cell: VIMap, offset_m: float) -> VIMap:
    T_M_I = cell.vertices.T_M_I.copy()
    T_M_I[:, 4] += offset_m
    return cell.replace(vertices=cell.vertices.replace(T_M_I=T_M_I))


def test_the_copy_that_is_deepest_is_taken() -> None:
    vi_map = sessions()
    cells = split_by_position(vi_map, CellOptions(count=3, overlap_m=0.1))
    joined, report = join_cells([moved(cell, 1e-3 * k) for k, cell in enumerate(cells)])
    rows = joined.vertex_index.rows(vi_map.vertices.id)
    x = joined.vertices.T_M_I[rows, 4] - vi_map.vertices.T_M_I[:, 4]
    taken = np.round(x / 1e-3).astype(int)
    for row, cell in enumerate(taken):
        assert cells[cell].vertex_index.rows(vi_map.vertices.id[[row]])[0] >= 0
    assert set(taken) == {0, 1, 2}
    assert report.vertices_differing > 0
    assert report.largest_shift_m == pytest.approx(2e-3, rel=0.51)


def test_another_base_frame_does_not_move_vertices() -> None:
    vi_map = sessions()
    first, *others = split_by_position(vi_map, OVERLAP)
    T_N_M = se3.exp(np.array([1.0, 2.0, 0.5, 0.0, 0.0, 0.7]))
    T_G_M = se3.compose(
        first.baseframes.T_G_M, np.broadcast_to(se3.inverse(T_N_M), (len(first.baseframes), 7))
    )
    T_M_I = se3.compose(np.broadcast_to(T_N_M, (len(first.vertices), 7)), first.vertices.T_M_I)
    other_frame = first.replace(
        baseframes=first.baseframes.replace(T_G_M=T_G_M),
        vertices=first.vertices.replace(T_M_I=T_M_I),
    )
    joined, _ = join_cells([*others, other_frame])
    assert difference(vi_map, joined) == []


def test_landmarks_that_one_cell_merged_are_merged() -> None:
    vi_map = sessions()
    cells = split_by_position(vi_map, OVERLAP)
    often = np.argsort(-np.diff(cells[0].observation_start))[:2]
    merged = edits.merge_landmarks(cells[0], often[:1], often[1:])
    joined, _ = join_cells([merged, *cells[1:]])
    assert consistency.check_consistency(joined).failure == ""
    assert len(joined.landmarks) in (len(vi_map.landmarks) - 1, len(vi_map.landmarks))


def test_what_all_cells_removed_is_gone_and_what_one_kept_stays() -> None:
    vi_map = sessions()
    cells = split_by_position(vi_map, OVERLAP)
    everywhere = vi_map.landmarks.id[:20]
    without = []
    for cell in cells:
        rows = cell.landmark_index.rows(everywhere)
        is_removed = np.zeros(len(cell.landmarks), dtype=np.bool_)
        is_removed[rows[rows >= 0]] = True
        without.append(edits.remove_landmarks(cell, is_removed))
    joined, _ = join_cells(without)
    assert (joined.landmark_index.rows(everywhere) < 0).all()
    assert len(joined.landmarks) == len(vi_map.landmarks) - 20
    kept, _ = join_cells([without[0], *cells[1:]])
    in_others = [(c.landmark_index.rows(everywhere) >= 0) for c in cells[1:]]
    stays = np.any(in_others, axis=0)
    assert np.array_equal(kept.landmark_index.rows(everywhere) >= 0, stays)


def test_maps_that_are_no_cells_are_refused() -> None:
    first, second = simulated().maps
    with pytest.raises(MapError, match="no mission of the cells before it"):
        join_cells([first, second])
    with pytest.raises(MapError, match="no cell with vertices"):
        join_cells([VIMap(), VIMap()])


def test_the_commands_are_inverse() -> None:
    session = Session()
    vi_map = sessions()
    session.maps.add("city", vi_map)
    session.run("split_map", cell_count=3, cell_overlap_m=0.6)
    session.run("delete_map", "city", yes=True)
    session.run("join_submaps", "city")
    assert session.maps.keys == ["city"]
    assert difference(vi_map, session.vi_map) == []
    for flags, said in (
        ({}, "needs two or more cells, found none"),
        ({"map_keys": "city,city"}, "names 'city' twice"),
        ({"map_keys": "city,nowhere"}, "no map has the key 'nowhere'"),
    ):
        with pytest.raises(UserError, match=said):
            session.run("join_submaps", "other", **flags)
    assert session.maps.keys == ["city"]
