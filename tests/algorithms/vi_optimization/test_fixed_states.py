"""States that stay: by flags, and as many directions as no measurement shows."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization.fixed_states import fix_gauge, hold_unconstrained
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import UserError
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.symbolic.sources import absolute_pose, relative_pose
from maplab_py.estimation.terms.pose import AbsolutePoseTerm, RelativePoseTerm
from maplab_py.geometry import se3
from maplab_py.progress import SILENT
from maplab_py.sensors import Distortion, Projection
from maplab_py.vimap import VIMap, edits, ragged_rows
from tests.support.dense import DenseProblem, dense_problem
from tests.support.scene import Scene, corrupted

EXACT = VIOptimizationOptions(
    num_iterations=40,
    initial_trust_region_radius=1e9,  # short chains of IMU edges leave directions that damping slows
    loss="none",
    use_visual_outlier_rejection_solver=False,
    gate_reprojection_error_px=1e9,
    function_tolerance=1e-12,
    gradient_tolerance=0.0,
    parameter_tolerance=1e-13,
)
SMALL = Scene(vertices=4, landmarks=40, noise=1.0)
TWO_CAMERAS = dataclasses.replace(
    SMALL, models=((Projection.PINHOLE, Distortion.NONE), (Projection.PINHOLE, Distortion.FOV))
)
TWO_MISSIONS = dataclasses.replace(SMALL, missions=2, vertices=3)


def without_edges(vi_map: VIMap, edges: list[int]) -> VIMap:
    """Remove some IMU edges and their samples."""
    rows = np.setdiff1d(np.arange(len(vi_map.imu_edges)), edges)
    return vi_map.replace(
        imu_edges=vi_map.imu_edges.take(rows),
        imu_samples=vi_map.imu_samples.take(ragged_rows(vi_map.sample_start, rows)),
    )


def without_sight(vi_map: VIMap, vertices: list[int]) -> VIMap:
    seen = np.isin(vi_map.keypoint_vertex, vertices) & (vi_map.keypoints.landmark >= 0)
    return edits.remove_observations(vi_map, np.flatnonzero(seen))


def apart(vi_map: VIMap) -> VIMap:
    """Take from the second mission every observation of the first one's landmarks."""
    own = vi_map.vertices.mission[vi_map.keypoint_vertex]
    landmark = vi_map.keypoints.landmark
    home = vi_map.vertices.mission[vi_map.landmarks.vertex[landmark]]
    return edits.remove_observations(vi_map, np.flatnonzero((landmark >= 0) & (own != home)))


def only_shown(vi_map: VIMap) -> VIMap:
    """Remove the landmarks that fewer than two observations are left of."""
    from maplab_py.vimap.edits import remove_landmarks

    return remove_landmarks(vi_map, np.flatnonzero(np.diff(vi_map.observation_start) < 2))


VI, VISUAL = {}, {"include_inertial": False}
CASES = {
    "visual-inertial": (SMALL.make(), VI, 4),
    "inertial": (SMALL.make(), {"include_visual": False}, 4),
    "one camera": (SMALL.make(), VISUAL, 7),
    "two cameras": (TWO_CAMERAS.make(), VISUAL, 6),
    "two missions in one cluster": (TWO_MISSIONS.make(), VI, 4),
    "two missions, images alone": (TWO_MISSIONS.make(), VISUAL, 7),
    "two missions in two clusters": (only_shown(apart(TWO_MISSIONS.make())), VI, 8),
    "two clusters of images": (only_shown(apart(TWO_MISSIONS.make())), VISUAL, 14),
    "an IMU edge is missing": (without_edges(SMALL.make(), [1]), VI, 4),
    "a vertex sees nothing": (only_shown(without_sight(SMALL.make(), [1])), VI, 4),
    "one mission without IMU": (
        without_edges(only_shown(apart(TWO_MISSIONS.make())), [2, 3]), VI, 4 + 7,
    ),
}  # fmt: skip


SLOW = ("inertial", "two missions, images alone", "two clusters of images", "a vertex sees nothing")
DETERMINED = (
    "visual-inertial", "one camera", "two cameras", "two missions, images alone",
)  # fmt: skip
"""Cases in which the gauge is all that measurements leave open; short chains of IMU edges leave
velocities and biases open, too."""


def dense_of(vi_map: VIMap, flags: dict[str, bool]) -> DenseProblem:
    dense = dense_problem(vi_map, **flags)
    dense.problem().linearize(dense.states, 0.0)  # integrates
    return dense


def null_and_fixed(dense: DenseProblem, **flags: bool) -> tuple[int, int, int]:
    """Return how many directions nothing shows, how many are fixed, and the rank that costs."""
    problem, vertices = dense.problem(), len(dense.states.T_G_I)
    held = hold_unconstrained(problem, dense.states)
    before = problem._projector.copy()
    settings = {"has_inertial": True, "has_fixed_landmarks": False, **flags}
    fix_gauge(problem, dense.states, held, **settings)
    fixed = round(float(np.trace(before - problem._projector, axis1=1, axis2=2).sum()))
    J = dense.exact_jacobian(dense.states)
    if settings["has_fixed_landmarks"]:
        J = J[:, : 15 * vertices]
    size = np.linalg.norm(J, axis=0)
    restricted = J.copy()
    restricted[:, : 15 * vertices] = np.einsum(
        "mni,nij->mnj",
        J[:, : 15 * vertices].reshape(len(J), -1, 3),
        problem._projector,
    ).reshape(len(J), -1)
    shown = size > 1e-9 * size.max()
    free, held_rank = (_rank(m[:, shown] / size[shown]) for m in (J, restricted))
    return int(shown.sum()) - free, fixed, free - held_rank


def _rank(J: np.ndarray) -> int:
    singular = np.linalg.svd(J, compute_uv=False)
    return int(np.count_nonzero(singular > 1e-9 * singular[0]))


@pytest.mark.parametrize("name", CASES)
def test_what_is_fixed_is_what_nothing_shows(name: str) -> None:
    vi_map, flags, wanted = CASES[name]
    null, fixed, lost = null_and_fixed(
        dense_of(vi_map, flags), has_inertial=flags.get("include_inertial", True)
    )
    assert fixed == wanted
    assert lost == 0  # no measurement sees what is fixed
    assert null == wanted if name in DETERMINED else null > wanted


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES],
)
def test_optimum_costs_no_more_than_the_free_one(name: str) -> None:
    vi_map, flags, _ = CASES[name]
    if "sees nothing" not in name:
        vi_map = corrupted(
            vi_map, np.random.default_rng(4), position_m=0.01, quaternion=0.002, keep=0
        )
    result, report = optimize(vi_map, dataclasses.replace(EXACT, **flags))
    dense = dense_of(result, flags)
    _, free = dense.minimum(dense.states, 2)
    assert report.cost_after == pytest.approx(free, rel=1e-8)
    assert report.cost_after < report.cost_before


@pytest.mark.parametrize("kind", ["absolute pose", "fixed landmarks"])
@pytest.mark.parametrize("flags", [VI, VISUAL])
def test_nothing_is_fixed_where_everything_is_shown(kind: str, flags: dict[str, bool]) -> None:
    fixes = kind == "fixed landmarks"
    dense = dense_problem(SMALL.make(), move_points=not fixes, **flags)
    if not fixes:
        pose = dense.states.T_G_I[1:2]
        kernel = residual_kernel("absolute_pose", absolute_pose)
        weight = 100.0 * np.eye(6)[None]
        dense.factors.append(AbsolutePoseTerm(kernel, np.array([1]), se3.identity(1), pose, weight))
    dense.problem().linearize(dense.states, 0.0)
    has_inertial = flags.get("include_inertial", True)
    null, fixed, _ = null_and_fixed(dense, has_inertial=has_inertial, has_fixed_landmarks=fixes)
    assert (fixed, null) == (0, 0 if fixes or has_inertial else 1)  # scale of one camera


def test_relative_poses_show_scale_and_join_clusters() -> None:
    dense = dense_of(only_shown(apart(TWO_MISSIONS.make())), VISUAL)
    T = dense.states.T_G_I
    first, second = np.array([0]), np.array([4])
    kernel = residual_kernel("relative_pose", relative_pose)
    measured, weight = se3.relative(T[first], T[second]), 100.0 * np.eye(6)[None]
    dense.factors.append(
        RelativePoseTerm(kernel, "loop closure", first, second, se3.identity(1), measured, weight)
    )
    _, fixed, _ = null_and_fixed(dense, has_inertial=False)
    assert fixed == 6


@pytest.mark.parametrize("include_inertial", [True, False])
def test_vertex_that_nothing_touches_stays(include_inertial: bool) -> None:
    scene = dataclasses.replace(SMALL, vertices=6)
    vi_map = without_edges(without_sight(scene.make(), [3]), [2, 3])
    result, report = optimize(vi_map, dataclasses.replace(EXACT, include_inertial=include_inertial))
    assert report.vertices_held == 1
    for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
        column = getattr(result.vertices, name)
        assert np.isfinite(column).all()
        np.testing.assert_allclose(column[3], getattr(vi_map.vertices, name)[3], atol=1e-14)
    assert report.cost_after < report.cost_before


def test_vertex_without_images_at_the_end_of_a_chain_of_images() -> None:
    vi_map = without_edges(without_sight(dataclasses.replace(SMALL, vertices=6).make(), [5]), [4])
    result, report = optimize(vi_map, EXACT)
    assert report.vertices_held == 1
    assert report.gauge == "position and heading of 1 cluster"
    np.testing.assert_allclose(result.vertices.T_M_I[5], vi_map.vertices.T_M_I[5], atol=1e-14)


@pytest.mark.parametrize("left", [1, 2])
def test_vertex_that_sees_too_little_does_no_harm_to_others(left: int) -> None:
    scene = dataclasses.replace(SMALL, vertices=6, landmarks=60)
    vi_map = scene.make()
    options = dataclasses.replace(EXACT, include_inertial=False)
    seen = np.flatnonzero((vi_map.keypoint_vertex == 3) & (vi_map.keypoints.landmark >= 0))
    poor, _ = optimize(edits.remove_observations(vi_map, seen[left:]), options)
    without, _ = optimize(edits.remove_observations(vi_map, seen), options)
    others = np.arange(6) != 3
    assert np.isfinite(poor.vertices.T_M_I).all()
    # the few pixels can be met by the poor vertex alone, at no cost for anybody else
    np.testing.assert_allclose(
        poor.vertices.T_M_I[others], without.vertices.T_M_I[others], atol=1e-5
    )


def test_measurement_of_some_directions_only_leaves_the_others_where_they_are() -> None:
    dense = dense_problem(SMALL.make())
    T = dense.states.T_G_I
    measured = se3.retract(T[1:2], np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.0]))
    weight = np.diag([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])[None]
    kernel = residual_kernel("absolute_pose", absolute_pose)
    term = AbsolutePoseTerm(kernel, np.array([1]), se3.identity(1), measured, weight)
    problem = Problem(dense.states, None, [term])
    final, summary = optimize_states(problem, dense.states, SolverOptions(), SILENT)
    assert sum(summary.final_costs.values()) <= 1e-12
    np.testing.assert_allclose(final.T_G_I[1, 4:], measured[0, 4:], atol=1e-8)
    np.testing.assert_allclose(final.T_G_I[1, :4], T[1, :4], atol=1e-12)
    np.testing.assert_allclose(final.T_G_I[[0, 2, 3]], T[[0, 2, 3]], atol=1e-15)


OPTIONS = VIOptimizationOptions(num_iterations=5)

# what a flag keeps: (attribute of the map, column)
KEPT = {
    "fix_vertices": [("vertices", "T_M_I")],
    "fix_velocity": [("vertices", "v_M")],
    "fix_gyro_bias": [("vertices", "gyro_bias")],
    "fix_accel_bias": [("vertices", "accel_bias")],
    "fix_landmark_positions": [("", "p_G")],
}
STATES = [column for columns in KEPT.values() for column in columns]


@cache
def start() -> VIMap:
    truth = Scene(missions=2, vertices=6, noise=1.0).make()
    rng = np.random.default_rng(2)
    return corrupted(
        truth,
        rng,
        position_m=0.01,
        quaternion=0.002,
        landmark_m=0.01,
        velocity_mps=0.02,
        gyro_bias=1e-3,
        accel_bias=0.02,
    )


def state(vi_map: VIMap, place: tuple[str, str]) -> np.ndarray:
    table = getattr(vi_map, place[0]) if place[0] else vi_map
    return np.asarray(getattr(table, place[1]))


@pytest.mark.parametrize("names", [[], *([name] for name in KEPT), list(KEPT)[1:], list(KEPT)[:4]])
def test_what_is_named_stays_and_the_rest_moves(names: list[str]) -> None:
    options = dataclasses.replace(OPTIONS, **dict.fromkeys(names, True))  # type: ignore[arg-type]
    result, report = optimize(start(), options)
    assert report.cost_after < report.cost_before
    kept = [place for name in names for place in KEPT[name]]
    for place in STATES:
        change = np.abs(state(result, place) - state(start(), place)).max()
        if place in kept:
            assert change <= 1e-13, place
        else:
            assert change >= 1e-5, place


def test_with_everything_fixed_the_map_stays_and_the_cost_is_told() -> None:
    options = dataclasses.replace(OPTIONS, **dict.fromkeys(KEPT, True))  # type: ignore[arg-type]
    result, report = optimize(start(), options)
    for place in STATES:
        np.testing.assert_allclose(state(result, place), state(start(), place), atol=1e-13)
    assert report.cost_after == pytest.approx(report.cost_before)
    assert report.cost_before > 0.0


@pytest.mark.parametrize("mission", [0, 1])
def test_missions_that_are_not_named_stay_to_the_last_bit(mission: int) -> None:
    result, _ = optimize(start(), OPTIONS, missions=np.array([mission]))
    other = start().vertices.mission != mission
    for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
        before, after = getattr(start().vertices, name), getattr(result.vertices, name)
        np.testing.assert_array_equal(after[other], before[other])
        assert np.abs(after[~other] - before[~other]).max() > 1e-5


def test_base_frames_that_nothing_could_move_are_refused() -> None:
    options = dataclasses.replace(
        OPTIONS, fix_vertices=True, absolute_pose_sensor_fix_mission_baseframes=False
    )
    with pytest.raises(UserError, match="--ba_fix_vertices keeps the base frames as well"):
        optimize(start(), options)
