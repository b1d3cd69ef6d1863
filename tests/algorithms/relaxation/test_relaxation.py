"""Relaxation of simulated loops with and without false closures, and the pose graph of a map."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from maplab_py.algorithms.relaxation import map_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import move_vertices, relax, relax_graph
from maplab_py.algorithms.relaxation.robust import independent_errors, variance_factor, with_tail
from maplab_py.estimation.problem.gauge import clusters
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.geometry import se3, so3
from maplab_py.simulation import evaluation, scenario_file
from maplab_py.simulation.simulate import simulate as simulate_scenario
from maplab_py.vimap import Landmarks, LoopClosureEdges, random_ids, to_hex
from tests.algorithms.relaxation.loops import Loop, ate, simulate

OPTIONS = RelaxationOptions()
PLAIN = RelaxationOptions(robustness="none")


def _relaxed_error(loop: Loop, closures: LoopClosureEdges, options=OPTIONS) -> float:
    relaxed, report = relax(loop.vi_map, options, loop_closures=closures)
    assert report.failure == ""
    return ate(relaxed.T_G_I, loop.T_G_I)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("drift", [1.0, 4.0])
def test_thirty_percent_false_closures_cost_nothing(seed, drift):
    loop = simulate(seed, false_share=0.3, drift=drift)
    clean = loop.closures.take(np.arange(loop.num_true))
    clean_error = _relaxed_error(loop, clean, PLAIN)
    assert clean_error < 0.6 * ate(loop.vi_map.T_G_I, loop.T_G_I)
    relaxed = relax_graph(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert ate(relaxed.vi_map.T_G_I, loop.T_G_I) <= 1.1 * clean_error
    assert relaxed.weight[: loop.num_true].min() > 0.9
    assert relaxed.weight[loop.num_true :].max() < 0.1
    assert _relaxed_error(loop, loop.closures, PLAIN) > 3.0 * clean_error
    num_false = len(loop.closures) - loop.num_true
    assert relaxed.report.num_switched_off == num_false
    assert relaxed.report.num_loop_closures == len(loop.closures)
    assert relaxed.report.cost_after < relaxed.report.cost_before


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (3, 7))])
def test_false_edges_of_the_scenario(seed):
    data = simulate_scenario(scenario_file.load_scenario("false_loop_edges").with_seed(seed))
    vi_map, truth = data.maps[0], data.truth
    is_true = truth.loop_edge_is_true
    right = vi_map.loop_closure_edges.take(np.flatnonzero(is_true))
    clean, _ = relax(vi_map.replace(loop_closure_edges=right), PLAIN)
    relaxed, report = relax(vi_map, OPTIONS)
    bent, _ = relax(vi_map, PLAIN)
    best = ate(clean.T_G_I, truth.T_G_I)
    assert ate(relaxed.T_G_I, truth.T_G_I) <= 1.1 * best
    assert ate(bent.T_G_I, truth.T_G_I) > 3.0 * best
    switch = relaxed.loop_closure_edges.switch_variable  # edges stay and say what became of them
    assert switch[is_true].min() > 0.9
    assert switch[~is_true].max() < 0.1
    assert evaluation.evaluate_map(relaxed, truth).false_loop_edges_trusted == 0
    assert report.num_switched_off == np.count_nonzero(~is_true)
    false = {to_hex(number) for number in vi_map.loop_closure_edges.id[~is_true]}
    assert len(report.worst) == 10
    assert all(off.closure in false and off.is_edge for off in report.worst)
    distance = [off.error_m for off in report.worst]
    assert distance == sorted(distance, reverse=True)
    assert min(distance) > 0.5
    told = report.as_dict()
    assert told["worst"][0]["closure"] == report.worst[0].closure
    assert told["num_switched_off"] == 20
    assert 0.0 < told["mean_correction_m"] < told["max_correction_m"]
    assert 0.0 < told["mean_correction_deg"] < told["max_correction_deg"]


def test_missions_are_pulled_together_and_one_vertex_stays():
    loop = simulate(2, missions=3)
    relaxed, report = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert report.num_clusters == 1
    assert report.num_vertices == 599
    np.testing.assert_allclose(relaxed.T_G_I[0], loop.vi_map.T_G_I[0], atol=1e-12)
    assert ate(relaxed.T_G_I, loop.T_G_I) < 0.6 * ate(loop.vi_map.T_G_I, loop.T_G_I)
    # what missions do as a whole, their base frames do: turn about the vertical, and shift
    assert report.num_base_frames == 2
    before, after = loop.vi_map, relaxed
    np.testing.assert_array_equal(after.baseframes.T_G_M[0], before.baseframes.T_G_M[0])
    moved = se3.local(before.baseframes.T_G_M[1:], after.baseframes.T_G_M[1:])
    assert np.linalg.norm(moved[:, :3], axis=1).min() > 0.01
    np.testing.assert_allclose(moved[:, 3:5], 0.0, atol=1e-12)
    first = before.vertex_start[1:3]
    stayed = so3.log(
        so3.multiply(after.vertices.T_M_I[first, :4], so3.inverse(before.vertices.T_M_I[first, :4]))
    )
    np.testing.assert_allclose(
        after.vertices.T_M_I[first, 4:], before.vertices.T_M_I[first, 4:], atol=1e-9
    )
    np.testing.assert_allclose(stayed[:, 2], 0.0, atol=1e-4)  # tilts a little, does not turn
    speed = so3.rotate(so3.inverse(before.vertices.T_M_I[:, :4]), before.vertices.v_M)
    turned = so3.rotate(so3.inverse(after.vertices.T_M_I[:, :4]), after.vertices.v_M)
    np.testing.assert_allclose(turned, speed, atol=1e-12)


def test_base_frames_that_missions_share_or_nobody_knows_stay():
    loop = simulate(2, missions=3, false_share=0.0)
    missions = loop.vi_map.missions.replace(baseframe=np.array([0, 1, 1]))
    shared = loop.vi_map.replace(
        missions=missions, baseframes=loop.vi_map.baseframes.take(np.arange(2))
    )
    relaxed, report = relax(shared, OPTIONS, loop_closures=loop.closures)
    assert report.num_base_frames == 0
    np.testing.assert_array_equal(relaxed.baseframes.T_G_M, shared.baseframes.T_G_M)
    own, _ = relax(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    np.testing.assert_allclose(relaxed.T_G_I, own.T_G_I, atol=1e-9)


def test_only_chosen_missions_move():
    loop = simulate(2, missions=3, false_share=0.0)
    relaxed, report = relax(
        loop.vi_map, OPTIONS, loop_closures=loop.closures, missions=np.array([0, 2])
    )
    other = loop.vi_map.vertices.mission == 1
    np.testing.assert_array_equal(relaxed.vertices.T_M_I[other], loop.vi_map.vertices.T_M_I[other])
    assert report.num_ignored > 0
    assert "not chosen" in report.notes[0]


def test_without_closures_the_map_stays_and_the_report_fails():
    loop = simulate(0)
    same, report = relax(loop.vi_map, OPTIONS)
    assert same is loop.vi_map
    assert report.failure == "no loop closure edges"
    unknown = simulate(0, missions=2, false_share=0.0)
    across = unknown.closures.take(np.arange(5))
    mission = np.zeros(600, dtype=np.int32)
    mission[300:] = 1
    vi_map = unknown.vi_map.replace(
        baseframes=unknown.vi_map.baseframes.replace(is_known=np.array([True, False]))
    )
    same, report = relax(vi_map, OPTIONS, loop_closures=across)
    assert same is vi_map
    assert "unknown base frame" in report.failure


def test_velocities_turn_and_landmarks_follow():
    vi_map = simulate(0).vi_map
    landmarks = Landmarks.filled(2, vertex=[3, 400], p_I=[[1.0, 2, 3], [4, 5, 6]])
    vi_map = vi_map.replace(landmarks=landmarks)
    turn = se3.make(so3.exp([0.0, 0.0, 0.3]), [1.0, -2.0, 0.5])
    rows = np.arange(100, 600)
    moved = move_vertices(vi_map, rows, se3.compose(turn, vi_map.T_G_I))
    np.testing.assert_array_equal(moved.vertices.T_M_I[:100], vi_map.vertices.T_M_I[:100])
    np.testing.assert_allclose(
        moved.vertices.v_M[rows], so3.rotate(turn[:4], vi_map.vertices.v_M[rows]), atol=1e-12
    )
    np.testing.assert_allclose(moved.p_G[1], se3.transform(turn, vi_map.p_G[1]), atol=1e-12)
    np.testing.assert_array_equal(moved.p_G[0], vi_map.p_G[0])


def raised(T_A_B: np.ndarray, T_G_A: np.ndarray, height_m: float) -> np.ndarray:
    """Return relative poses whose second pose lies higher in G."""
    moved = T_A_B.copy()
    moved[:, 4:] += so3.rotate(so3.inverse(T_G_A[:, :4]), [0.0, 0.0, height_m])
    return moved


def with_false_neighbours(loop: Loop, count: int, height_m: float, seed: int) -> Loop:
    """Add closures of neighbouring vertices that all put the second lap too high."""
    rng = np.random.default_rng(seed)
    first = int(rng.integers(20, 260)) + np.arange(count) // 2
    second = first + 300
    T_A_B = se3.relative(loop.T_G_I[first], loop.T_G_I[second])
    false = LoopClosureEdges.filled(
        count,
        id=random_ids(count, rng),
        from_vertex=first,
        to_vertex=second,
        T_A_B=raised(T_A_B, loop.T_G_I[first], height_m),
        covariance=loop.closures.covariance[:count],
    )
    closures = LoopClosureEdges.concatenate([loop.closures, false])
    return dataclasses.replace(loop, closures=closures)


@pytest.mark.parametrize(("seed", "height_m"), [(1, 0.5), (3, 0.6)])
def test_false_neighbours_that_bend_the_trajectory_are_judged_without_them(seed, height_m):
    # while they count, their errors are no larger than those of a tail of true closures
    loop = with_false_neighbours(simulate(seed, false_share=0.0), 4, height_m, seed)
    relaxed = relax_graph(loop.vi_map, OPTIONS, loop_closures=loop.closures)
    assert relaxed.weight.tolist() == [1.0] * 80 + [0.0] * 4


def test_a_confident_minority_does_not_outvote_the_majority():
    # 30 closures put the second lap 5 m too high; the 50 true ones are five times less certain
    loop = simulate(0, false_share=0.0)
    rows = np.sort(np.random.default_rng(0).permutation(80)[:30])
    others = np.setdiff1d(np.arange(80), rows)
    T_A_B, covariance = loop.closures.T_A_B.copy(), loop.closures.covariance.copy()
    T_A_B[rows] = raised(T_A_B[rows], loop.T_G_I[loop.closures.from_vertex[rows]], 5.0)
    covariance[others] *= 25.0
    closures = loop.closures.replace(T_A_B=T_A_B, covariance=covariance)
    relaxed = relax_graph(loop.vi_map, OPTIONS, loop_closures=closures)
    assert np.all(relaxed.weight[others] == 1.0)
    assert np.all(relaxed.weight[rows] == 0.0)
    assert ate(relaxed.vi_map.T_G_I, loop.T_G_I) < 0.2


@pytest.fixture(scope="module")
def adjustment():
    """Return 40 linear measurements (N, 6) of 30 unknowns, their whitened rows, and noise."""
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(40, 6, 30))
    return rows, rng.normal(size=(40, 6))


def _solved(rows, measured, counts):
    """Return errors and the uncertainty of the prediction, some measurements left out."""
    A = rows[counts].reshape(-1, 30)
    N = np.linalg.inv(A.T @ A)
    x = N @ A.T @ measured[counts].reshape(-1)
    return rows @ x - measured, rows @ N @ rows.transpose(0, 2, 1)


def test_errors_are_those_against_all_others(adjustment):
    rows, measured = adjustment
    everything = np.ones(40, dtype=np.bool_)
    with_all = independent_errors(*_solved(rows, measured, everything), everything)
    for row in range(5):
        others = everything.copy()
        others[row] = False
        without = independent_errors(*_solved(rows, measured, others), others)
        assert with_all[row] == pytest.approx(without[row], rel=1e-9)


def test_independent_errors_are_chi_squared(adjustment):
    rows, _ = adjustment
    counts = np.arange(40) % 3 > 0
    rng = np.random.default_rng(5)
    u = np.concatenate(
        [
            independent_errors(*_solved(rows, rng.normal(size=(40, 6)), counts), counts)
            for _ in range(50)
        ]
    )
    for share in (0.1, 0.5, 0.9, 0.99):
        assert np.quantile(u, share) == pytest.approx(chi2(6).ppf(share), rel=0.1)


def test_what_nothing_controls_has_no_error():
    u = independent_errors(np.full((1, 6), 1e-9), np.eye(6)[None], np.array([True]))
    assert u[0] < 1e-9


def test_variance_factor_is_that_of_the_noise_and_stays_within_reason():
    u = chi2(6).rvs(1000, random_state=1)
    assert variance_factor(u) == pytest.approx(1.0, rel=0.1)
    assert variance_factor(1e-3 * u) == pytest.approx(1e-3, rel=0.5)
    assert variance_factor(np.append(u, np.full(200, 1e9))) < 1.4
    assert variance_factor(1e3 * u) == 4.0
    assert variance_factor(1e-3 * u[:5]) > 0.5  # so few show little
    assert variance_factor(np.zeros(3)) > 0.0


def test_a_tail_is_kept_and_what_lies_beyond_the_gap_is_not():
    core = np.full(100, 5.0)
    u = np.concatenate([core, [25.0, 40.0, 70.0], [400.0, 420.0, 9e4]])
    assert with_tail(u, 20.0).tolist() == [True] * 103 + [False] * 3


def test_without_a_gap_the_limit_decides():
    core = np.full(20, 5.0)
    u = np.concatenate([core, np.geomspace(25.0, 1e4, 30)])
    np.testing.assert_array_equal(with_tail(u, 20.0), u <= 20.0)


def test_nothing_far_away_is_a_tail():
    u = np.concatenate([np.full(1000, 5.0), np.geomspace(21.0, 1e5, 40)])
    assert u[with_tail(u, 20.0)].max() <= 2000.0


def test_a_lone_error_is_judged_by_the_limit():
    assert with_tail(np.array([19.0]), 20.0).tolist() == [True]
    assert with_tail(np.array([21.0]), 20.0).tolist() == [False]
    assert with_tail(np.zeros(0), 20.0).tolist() == []


YAW = np.array([0.0, 0.0, 0.7])


def test_trajectory_edges_join_neighbours_and_fit_the_map_exactly():
    vi_map = simulate(0, missions=3).vi_map
    edges = map_edges.trajectory_edges(vi_map, OPTIONS)
    assert len(edges) == 600 - 3
    mission = vi_map.vertices.mission
    assert np.all(mission[edges.from_vertex] == mission[edges.to_vertex])
    np.testing.assert_allclose(edges.errors(vi_map.T_G_I), 0.0, atol=1e-9)


def test_trajectory_edges_do_not_feel_a_common_yaw_and_shift():
    vi_map = simulate(0).vi_map
    turn = se3.make(so3.exp(YAW), [3.0, 2.0, 1.0])
    edges = map_edges.trajectory_edges(vi_map, OPTIONS)
    np.testing.assert_allclose(edges.errors(se3.compose(turn, vi_map.T_G_I)), 0.0, atol=1e-9)


def test_tilting_costs_more_than_turning():
    vi_map = simulate(0).vi_map
    edges = map_edges.trajectory_edges(vi_map, OPTIONS)
    middle = 300
    tails = []
    for axis in range(3):  # turn the second half about an axis of G through its first vertex
        T = vi_map.T_G_I.copy()
        pivot = se3.make(so3.identity(), T[middle, 4:])
        turn = se3.make(so3.exp(np.eye(3)[axis] * 0.01), np.zeros(3))
        about = se3.compose(se3.compose(pivot, turn), se3.inverse(pivot))
        T[middle:] = se3.compose(about, T[middle:])
        tails.append(float(np.sum(edges.errors(T) ** 2)))
    sigma_yaw = np.deg2rad(OPTIONS.yaw_drift_deg) * np.sqrt(0.3)
    np.testing.assert_allclose(tails[2], (0.01 / sigma_yaw) ** 2, rtol=1e-6)
    assert min(tails[:2]) > 10.0 * tails[2]


def test_loop_edges_take_covariances_and_replace_unusable_ones():
    closures = simulate(0).closures
    covariance = closures.covariance.copy()
    covariance[0] = np.nan
    covariance[1] = -np.eye(6)
    covariance[2] = 1e-7 * np.eye(6)
    edges = map_edges.loop_edges(closures.replace(covariance=covariance), OPTIONS)
    implied = np.linalg.inv(edges.sqrt_information.transpose(0, 2, 1) @ edges.sqrt_information)
    floor = np.diag(np.repeat([0.03, np.deg2rad(0.5)], 3) ** 2)
    fallback = (
        np.diag(np.repeat([OPTIONS.loop_sigma_m, np.deg2rad(OPTIONS.loop_sigma_deg)], 3)) ** 2
    )
    np.testing.assert_allclose(implied[0], fallback + floor, atol=1e-12)
    np.testing.assert_allclose(implied[1], fallback + floor, atol=1e-12)
    np.testing.assert_allclose(implied[2], floor + 1e-7 * np.eye(6), atol=1e-12)
    np.testing.assert_allclose(implied[3], closures.covariance[3] + floor, atol=1e-12)


def _numeric(function, T, vertex):
    """Return the derivatives of function(T) by the twist of one vertex, (..., 6)."""
    columns = []
    for axis in range(6):
        sides = []
        for sign in (1.0, -1.0):
            moved = T.copy()
            moved[vertex] = se3.compose(T[vertex], se3.exp(sign * 1e-6 * np.eye(6)[axis]))
            sides.append(function(moved))
        columns.append((sides[0] - sides[1]) / 2e-6)
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("kind", PoseError)
def test_derivatives_match_finite_differences(kind):
    loop = simulate(1)
    T = loop.vi_map.T_G_I.copy()
    edges = map_edges.loop_edges(loop.closures.take(np.arange(3)), OPTIONS)
    # exact, a small and a large error
    T_A_B = se3.relative(T[edges.from_vertex], T[edges.to_vertex])
    error = np.array([[0.0] * 6, [0.01, 0.0, 0.02, 0.001, -0.002, 0.0], [1, 2, -1, 0.5, -1.5, 1]])
    T_A_B = se3.compose(T_A_B, se3.inverse(se3.exp(error)))
    edges = dataclasses.replace(edges, T_A_B=T_A_B, error=kind)
    if kind is PoseError.LOGARITHM:
        whitened = np.einsum("eij,ej->ei", edges.sqrt_information, error)
        np.testing.assert_allclose(edges.errors(T), whitened, rtol=1e-9, atol=1e-9)
    J_a, J_b = np.moveaxis(edges.linearized(T)[1], 1, 0)
    scale = np.abs(J_b).max()
    for row in range(3):
        numeric_a = _numeric(lambda T, r=row: edges.errors(T)[r], T, edges.from_vertex[row])
        numeric_b = _numeric(lambda T, r=row: edges.errors(T)[r], T, edges.to_vertex[row])
        np.testing.assert_allclose(J_a[row], numeric_a, atol=1e-6 * scale)
        np.testing.assert_allclose(J_b[row], numeric_b, atol=1e-6 * scale)


def test_unusable_closures_are_left_out_with_a_reason():
    loop = simulate(0, missions=3)
    vi_map = loop.vi_map
    mission = vi_map.vertices.mission
    everything, notes = map_edges.usable_loop_closures(vi_map, loop.closures, None)
    assert len(everything) == len(loop.closures)
    assert notes == []
    some, notes = map_edges.usable_loop_closures(vi_map, loop.closures, np.array([0, 1]))
    assert 0 < len(some) < len(everything)
    assert np.all(mission[some.from_vertex] < 2)
    assert np.all(mission[some.to_vertex] < 2)
    assert "missions not chosen" in notes[0]
    known = np.array([True, True, False])
    floating = vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known))
    some, notes = map_edges.usable_loop_closures(floating, loop.closures, None)
    a, b = mission[some.from_vertex], mission[some.to_vertex]
    assert np.all((a == b) | ((a < 2) & (b < 2)))
    assert np.any(a == 2)  # its own closures still count
    assert "unknown base frame" in notes[0]
    itself = loop.closures.replace(to_vertex=loop.closures.from_vertex)
    some, notes = map_edges.usable_loop_closures(vi_map, itself, None)
    assert len(some) == 0
    assert "with itself" in notes[0]


def test_clusters_are_missions_joined_by_closures():
    loop = simulate(0, missions=2, false_share=0.0)
    trajectory = map_edges.trajectory_edges(loop.vi_map, OPTIONS)
    none = map_edges.loop_edges(loop.closures.take(np.zeros(0, dtype=int)), OPTIONS)
    joined = map_edges.loop_edges(loop.closures, OPTIONS)
    for loops, count in ((none, 2), (joined, 1)):
        links = [(edges.from_vertex, edges.to_vertex) for edges in (trajectory, loops)]
        assert len(np.unique(clusters(600, links))) == count
