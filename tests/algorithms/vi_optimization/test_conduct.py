"""Conduct: cancelling, limits, hopeless input, threads, and the choice of the linear solver."""

import dataclasses
import time

import numpy as np
import pytest

from maplab_py.algorithms.vi_optimization import linear_solver
from maplab_py.algorithms.vi_optimization.map_problem import build
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.errors import Cancelled, EstimationError, FlagError, MaplabError, UserError
from maplab_py.estimation.linear import supernodal_solver
from maplab_py.estimation.problem.iterative import IterativeProblem
from maplab_py.memory import NotEnoughMemory
from maplab_py.progress import SilentProgress
from maplab_py.vimap import VIMap, to_hex
from tests.support.scene import Scene, corrupted

OPTIONS = VIOptimizationOptions(function_tolerance=0.0, parameter_tolerance=0.0)


def start() -> VIMap:
    rng = np.random.default_rng(2)
    truth = Scene(missions=2, vertices=8, noise=1.0).make()
    return corrupted(truth, rng, position_m=0.02, quaternion=0.005, landmark_m=0.02)


class Watcher(SilentProgress):
    """Keeps the lines and cancels at the n-th check."""

    def __init__(self, cancel_at: int = 10**9, pause_s: float = 0.0) -> None:
        self.lines: list[str] = []
        self.checks, self._cancel_at, self._pause_s = 0, cancel_at, pause_s

    def line(self, text: str) -> None:
        self.lines.append(text)

    def check(self) -> None:
        self.checks += 1
        time.sleep(self._pause_s)
        if self.checks >= self._cancel_at:
            raise Cancelled("cancelled")


def contents(vi_map: VIMap) -> list[bytes]:
    tables = (vi_map.vertices, vi_map.landmarks, vi_map.baseframes, vi_map.keypoints)
    return [
        column.tobytes()
        for table in tables
        for column in table.columns().values()
        if column.dtype != object
    ]


@pytest.mark.parametrize("cancel_at", [1, 3])
@pytest.mark.parametrize("hide", [False, True])
def test_cancelling_between_iterations_leaves_the_map_untouched(cancel_at: int, hide: bool) -> None:
    vi_map, watcher = start(), Watcher(cancel_at)
    before = contents(vi_map)
    options = dataclasses.replace(OPTIONS, hide_iterations_console_output=hide)
    with pytest.raises(Cancelled):
        optimize(vi_map, options, progress=watcher)
    iterations = [line for line in watcher.lines if not line.startswith("compiling")]
    assert len(iterations) == (0 if hide else cancel_at - 1)
    assert contents(vi_map) == before


def test_no_time_means_no_iteration() -> None:
    vi_map = start()
    result, report = optimize(vi_map, dataclasses.replace(OPTIONS, max_time_seconds=0.0))
    assert (report.termination, report.iterations) == ("time limit", 0)
    np.testing.assert_allclose(result.vertices.T_M_I, vi_map.vertices.T_M_I, atol=1e-13)


def test_time_limit_stops_between_iterations_and_keeps_what_was_reached() -> None:
    options = dataclasses.replace(OPTIONS, max_time_seconds=1.0, num_iterations=1000)
    _, report = optimize(start(), options, progress=Watcher(pause_s=0.3))
    assert report.termination == "time limit"
    assert 1 <= report.iterations <= 4
    assert report.cost_after < report.cost_before


def test_no_iterations_only_evaluate() -> None:
    _, report = optimize(start(), dataclasses.replace(OPTIONS, num_iterations=0))
    assert report.iterations == 0
    assert report.cost_after == pytest.approx(report.cost_before)


def with_state(vi_map: VIMap, column: str, value: float) -> VIMap:
    values = getattr(vi_map.vertices, column).copy()
    values[3, 0] = value
    return vi_map.replace(vertices=vi_map.vertices.replace(**{column: values}))


@pytest.mark.parametrize("column", ["T_M_I", "v_M", "gyro_bias", "accel_bias"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.filterwarnings("error")
def test_states_that_are_no_numbers_are_named(column: str, value: float) -> None:
    vi_map = start()
    with pytest.raises(UserError) as raised:
        optimize(with_state(vi_map, column, value), OPTIONS)
    message = str(raised.value)
    assert column in message
    assert to_hex(vi_map.vertices.id[3]) in message
    assert "\n" not in message


def test_images_alone_do_not_mind_velocities_that_are_no_numbers() -> None:
    vi_map = start()
    options = dataclasses.replace(OPTIONS, include_inertial=False, num_iterations=5)
    result, _ = optimize(with_state(vi_map, "v_M", np.nan), options)
    expected, _ = optimize(vi_map, options)
    np.testing.assert_array_equal(result.vertices.T_M_I, expected.vertices.T_M_I)
    with pytest.raises(UserError, match="T_M_I"):
        optimize(with_state(vi_map, "T_M_I", np.nan), options)


def test_measurements_that_are_no_numbers_are_named() -> None:
    vi_map = start()
    readings = vi_map.imu_samples.accel_gyro.copy()
    readings[100, 4] = np.nan
    broken = vi_map.replace(imu_samples=vi_map.imu_samples.replace(accel_gyro=readings))
    with pytest.raises(MaplabError, match=r"IMU edge [0-9a-f]{32}: sample \d+ is not a number"):
        optimize(broken, OPTIONS)


def test_keypoints_that_are_no_numbers_do_not_take_part() -> None:
    vi_map = start()
    uv = vi_map.keypoints.uv_px.copy()
    uv[vi_map.observations[0]] = np.nan
    broken = vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv))
    result, report = optimize(broken, dataclasses.replace(OPTIONS, num_iterations=10))
    assert report.observations_not_used == 1
    for column in (result.vertices.T_M_I, result.landmarks.p_I, report.cost_after):
        assert np.isfinite(column).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_landmarks_that_are_no_numbers_are_triangulated_anew(value: float) -> None:
    truth = Scene(vertices=12, noise=1.0).make()
    p_I = truth.landmarks.p_I.copy()
    p_I[5] = value
    broken = truth.replace(landmarks=truth.landmarks.replace(p_I=p_I))
    result, report = optimize(broken, VIOptimizationOptions())
    clean, expected = optimize(truth, VIOptimizationOptions())
    assert report.cost_after == pytest.approx(expected.cost_after, rel=1e-3)
    np.testing.assert_allclose(result.landmarks.p_I, clean.landmarks.p_I, atol=0.02)


def test_map_without_usable_measurements_is_one_clear_error() -> None:
    vi_map = start()
    empty = vi_map.replace(
        keypoints=vi_map.keypoints.replace(landmark=np.full(len(vi_map.keypoints), -1))
    )
    options = dataclasses.replace(OPTIONS, include_inertial=False)
    with pytest.raises(EstimationError, match="nothing to optimise"):
        optimize(empty, options)


SESSIONS = Scene(missions=2, vertices=12, landmarks=200, noise=1.0)


class Lines(SilentProgress):
    """Keeps the lines about the linear solver."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def line(self, text: str) -> None:
        """Keep a line."""
        if text.startswith("linear solver"):
            self.lines.append(text)


def sessions() -> VIMap:
    return corrupted(
        SESSIONS.make(),
        np.random.default_rng(2),
        position_m=0.03,
        quaternion=0.005,
        landmark_m=0.03,
    )


def built(**flags: object) -> tuple[bool, list[str]]:
    """Tell whether the problem is iterative, and what was said about it."""
    progress = Lines()
    options = VIOptimizationOptions(**flags)  # type: ignore[arg-type]
    problem = build(sessions(), options, progress=progress).problem
    return isinstance(problem, IterativeProblem), progress.lines


def test_small_maps_stay_direct_without_a_word() -> None:
    assert built() == (False, [])
    assert built(linear_solver_type="multifrontal") == (False, [])


def test_many_pairs_of_observations_decide_without_an_analysis(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(linear_solver, "ITERATIVE_FROM", 1.0)
    monkeypatch.setattr(linear_solver, "analyse", None)
    is_iterative, (line,) = built()
    assert is_iterative
    assert "would take as long as at least" in line


def test_between_the_bounds_the_graph_of_the_vertices_decides(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    map_problem = build(sessions(), VIOptimizationOptions())
    visual = map_problem.problem.visual
    assert visual is not None
    bound = linear_solver.predict_costs(visual)
    assert bound.is_bound
    monkeypatch.setattr(linear_solver, "ITERATIVE_FROM", 0.999 * bound.break_even)
    exact = linear_solver.predict_costs(visual)
    assert not exact.is_bound
    assert 0.0 < exact.break_even <= bound.break_even
    monkeypatch.setattr(linear_solver, "_FLOPS_PER_S", 1e3)  # factorisations take for ever
    is_iterative, (line,) = built()
    assert is_iterative
    assert "would take as long as at least" not in line


def test_conjugate_gradients_where_the_direct_solver_does_not_fit() -> None:
    is_iterative, lines = built(max_memory_gb=1e-4)
    assert is_iterative
    assert lines == ["linear solver: conjugate gradients, since the direct solver does not fit"]


def test_steps_are_as_exact_as_the_forcing_says() -> None:
    iterations = [
        optimize(sessions(), VIOptimizationOptions(linear_solver_type="pcg", pcg_forcing=forcing))[
            1
        ].linear_iterations
        for forcing in (0.1, 1e-5)
    ]
    assert iterations[0] < iterations[1]
    for forcing in (0.0, 1.0, -0.1, float("nan")):
        with pytest.raises(FlagError, match=r"--ba_pcg_forcing=.* must be above 0 and below 1"):
            built(pcg_forcing=forcing)


def test_a_large_factor_is_announced_before_it_is_allocated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(supernodal_solver, "_WORTH_TELLING", 0.0)
    is_iterative, lines = built()
    assert not is_iterative
    assert lines == ["linear solver: direct, a factor of 0.00 GB in 0 Gflop an iteration"]
    with pytest.raises(NotEnoughMemory):
        built(linear_solver_type="multifrontal", max_memory_gb=1e-4)


def test_the_direct_solver_refuses_and_names_the_remedies() -> None:
    with pytest.raises(NotEnoughMemory) as error:
        built(linear_solver_type="multifrontal", max_memory_gb=1e-4)
    assert "--ba_linear_solver_type=pcg" in str(error.value)
    assert "--ba_max_memory_gb" in str(error.value)


def test_estimated_cameras_take_the_direct_solver_and_say_so() -> None:
    is_iterative, lines = built(linear_solver_type="pcg", fix_ncamera_intrinsics=False)
    assert not is_iterative
    assert lines == [
        "linear solver: direct, since conjugate gradients do not support cameras that are estimated"
    ]
    is_iterative, lines = built(fix_ncamera_intrinsics=False)
    assert (is_iterative, lines) == (False, [])


@pytest.mark.parametrize(
    "flags",
    [
        {"fix_imu_intrinsics": False},
        {"fix_landmark_positions": True},
        {"fix_velocity": True, "fix_gyro_bias": True},
        {"include_inertial": False},
        {"position_prior_sigma_m": 0.1, "landmark_prior_sigma_m": 0.1},
        {"loss": "huber"},
    ],
    ids=lambda flags: next(iter(flags)),
)
def test_whatever_is_estimated_the_optimum_is_that_of_the_direct_solver(
    flags: dict[str, object],
) -> None:
    """Begin near the optimum: IMU edges are integrated where the biases were on the way there."""
    near, _ = optimize(sessions(), VIOptimizationOptions(loss="none", num_iterations=5))
    costs = []
    for name in ("multifrontal", "pcg"):
        options = VIOptimizationOptions(
            linear_solver_type=name, num_iterations=100, function_tolerance=1e-12,
            use_visual_outlier_rejection_solver=False, **flags,  # type: ignore[arg-type]
        )  # fmt: skip
        costs.append(optimize(near, options)[1].cost_after)
    assert costs[1] == pytest.approx(costs[0], rel=1e-8)
