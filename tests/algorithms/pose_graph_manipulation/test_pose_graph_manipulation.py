"""Vertices removed, edges merged, and missions at rest that are tied."""

import numpy as np
import pytest

from maplab_py.algorithms.pose_graph_manipulation.edges import (
    EdgeType,
    assign_covariance,
    assign_switch_variables,
    tie_stationary,
)
from maplab_py.algorithms.pose_graph_manipulation.layout import (
    DisturbanceOptions,
    LayoutOptions,
    distribute_missions,
    disturb_vertices,
)
from maplab_py.algorithms.pose_graph_manipulation.stationary_options import StationaryOptions
from maplab_py.errors import FlagError, UserError
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap, consistency, edits, merge, to_hex
from tests.simulation.small import simulated
from tests.vimap.builders import walk_map


@pytest.mark.parametrize("edge_type", [EdgeType.LOOP_CLOSURE, EdgeType.ODOMETRY])
def test_edges_of_one_type_get_the_covariance(edge_type):
    m = walk_map()
    result, count = assign_covariance(m, edge_type, position_sigma_m=0.1, orientation_sigma_deg=2.0)
    names = {EdgeType.LOOP_CLOSURE: "loop_closure_edges", EdgeType.ODOMETRY: "transformation_edges"}
    name = names.pop(edge_type)
    changed = getattr(result, name).covariance
    assert count == len(changed) > 0
    expected = np.diag(np.repeat([0.1, np.deg2rad(2.0)], 3) ** 2)
    np.testing.assert_allclose(changed, np.broadcast_to(expected, changed.shape))
    (other,) = names.values()
    assert getattr(result, other) is getattr(m, other)


def test_missing_edges_and_bad_values_are_refused():
    m = walk_map()
    with pytest.raises(UserError, match="wheel_odometry"):
        assign_covariance(
            m, EdgeType.WHEEL_ODOMETRY, position_sigma_m=1.0, orientation_sigma_deg=1.0
        )
    with pytest.raises(FlagError, match="translation_std_dev_meters"):
        assign_covariance(m, EdgeType.ODOMETRY, position_sigma_m=-1.0, orientation_sigma_deg=1.0)
    with pytest.raises(FlagError, match="lc_switch_variable_value"):
        assign_switch_variables(m, value=1.5)
    with pytest.raises(FlagError, match="variance"):
        assign_switch_variables(m, variance=0.0)
    without = edits.remove_loop_closure_edges(m, np.array([0, 1]))
    with pytest.raises(UserError, match="no loop closure edge"):
        assign_switch_variables(without, value=0.5)


def test_switch_variables_are_set():
    m = walk_map()
    result, count = assign_switch_variables(m, value=0.25)
    assert count == 2
    assert result.loop_closure_edges.switch_variable.tolist() == [0.25, 0.25]
    result, _ = assign_switch_variables(m, variance=1e-3)
    assert result.loop_closure_edges.switch_variable_variance.tolist() == [1e-3, 1e-3]
    assert result.loop_closure_edges.switch_variable.tolist() == [1.0, 1.0]


def test_disturbance_starts_at_zero_and_stays_within_its_limits():
    m, _ = merge.merge_maps(walk_map(vertices=200), walk_map(seed=1))
    options = DisturbanceOptions(
        max_translational_disturbance_norm_m=0.03,
        translation_random_walk_sigma_m=0.01,
        yaw_angle_stddev_rad=0.01,
    )
    result, report = disturb_vertices(m, options, missions=np.array([0]))
    shift = result.vertices.T_M_I[:, 4:] - m.vertices.T_M_I[:, 4:]
    mine = m.vertices.mission == 0
    np.testing.assert_array_equal(result.vertices.T_M_I[~mine], m.vertices.T_M_I[~mine])
    np.testing.assert_array_equal(shift[np.flatnonzero(mine)[0]], 0.0)
    assert np.linalg.norm(shift, axis=1).max() == pytest.approx(0.03)
    assert report.largest_shift_m == pytest.approx(0.03)
    turn = so3.log(so3.multiply(result.vertices.T_M_I[:, :4], so3.inverse(m.vertices.T_M_I[:, :4])))
    np.testing.assert_allclose(turn[:, :2], 0.0, atol=1e-9)
    assert 0.0 < np.abs(turn[:, 2]).max() <= 0.05 + 1e-9
    speed = np.linalg.norm(result.vertices.v_M, axis=1)
    np.testing.assert_allclose(speed, np.linalg.norm(m.vertices.v_M, axis=1))
    # landmarks keep their place in the vertex that stores them
    np.testing.assert_array_equal(result.landmarks.p_I, m.landmarks.p_I)


def test_the_same_seed_disturbs_equally():
    m = walk_map()
    a, b, c = (
        disturb_vertices(m, DisturbanceOptions(random_generator_seed=seed))[0].vertices.T_M_I
        for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.0


def test_missions_of_unknown_base_frame_are_laid_apart():
    m, _ = merge.merge_maps(walk_map(), walk_map(seed=1))
    m, _ = merge.merge_maps(m, walk_map(seed=2))
    known = m.baseframes.replace(is_known=[True, False, False])
    m = m.replace(baseframes=known)
    row, count = distribute_missions(m, LayoutOptions(meters=10.0, dimension=1))
    assert count == 2
    np.testing.assert_array_equal(row.T_G_M[0], m.T_G_M[0])
    np.testing.assert_array_equal(row.T_G_M[1:, 4:], [[0.0, 10.0, 0.0], [0.0, 20.0, 0.0]])
    np.testing.assert_array_equal(row.T_G_M[:, :4], m.T_G_M[:, :4])
    circle, _ = distribute_missions(m, LayoutOptions(meters=10.0, around_circle=True))
    np.testing.assert_allclose(np.linalg.norm(circle.T_G_M[1:, 4:], axis=1), 10.0)
    everything = m.replace(baseframes=m.baseframes.replace(is_known=[True] * 3))
    same, count = distribute_missions(everything, LayoutOptions())
    assert same is everything
    assert count == 0
    with pytest.raises(FlagError, match="dimension"):
        LayoutOptions(dimension=3)


def test_optimisation_is_not_needed_to_undo_no_disturbance():
    m = walk_map()
    still = DisturbanceOptions(max_translational_disturbance_norm_m=0.0, max_yaw_angle_rad=0.0)
    result, report = disturb_vertices(m, still)
    step = se3.local(m.vertices.T_M_I, result.vertices.T_M_I)
    np.testing.assert_allclose(step, 0.0, atol=1e-12)
    assert report.largest_turn_rad == 0.0


OPTIONS = StationaryOptions()


def standing(vi_map: VIMap, mission: int, moved_m: float) -> VIMap:
    """Let a mission stand still but for a small shift of its middle."""
    T_M_I = vi_map.vertices.T_M_I.copy()
    rows = np.flatnonzero(vi_map.vertices.mission == mission)
    T_M_I[rows] = T_M_I[rows[0]]
    T_M_I[rows[len(rows) // 2], 4] += moved_m
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))


def test_only_the_mission_that_stands_still_is_tied_and_only_once() -> None:
    both = standing(merge.merge_maps(*simulated().maps)[0], 1, 0.05)
    tied, missions = tie_stationary(both, OPTIONS)
    assert missions == (to_hex(both.missions.id[1]),)
    edges = tied.loop_closure_edges
    rows = np.flatnonzero(both.vertices.mission == 1)
    assert (edges.from_vertex.tolist(), edges.to_vertex.tolist()) == ([rows[0]], [rows[-1]])
    assert np.array_equal(edges.T_A_B[0], se3.identity())
    assert consistency.check_consistency(tied).errors == ()
    again, _ = tie_stationary(tied, OPTIONS)
    assert len(again.loop_closure_edges) == 1


def test_a_mission_that_moves_in_between_is_not_tied() -> None:
    vi_map = simulated().maps[0]
    moved = standing(vi_map, 0, 0.15)
    assert tie_stationary(moved, OPTIONS) == (moved, ())
    assert tie_stationary(vi_map, OPTIONS) == (vi_map, ())
