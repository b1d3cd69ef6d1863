"""Reprojection of every camera model, and the structure of visual problems."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.codegen.kernels import visual_kernels, window_kernels
from maplab_py.estimation.kernels.schur_products import KeptSystem, PoseSums
from maplab_py.estimation.kernels.visual_arguments import VisualData, VisualStates
from maplab_py.estimation.kernels.window_arguments import (
    FRAME_SIZE,
    DenseSystem,
    Elimination,
    WindowData,
    WindowPoint,
    WindowRule,
)
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.terms import visual_structure
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.terms.visual_structure import EliminationPlan, elimination_plan
from maplab_py.estimation.window.calibration import WindowCalibration
from maplab_py.estimation.window.options import CALIBRATED
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Distortion, Projection
from maplab_py.sensors.projection import project
from maplab_py.vimap.table import starts_of_counts
from tests.estimation.dense import assert_relative, differences
from tests.support.scene import EVERY_MODEL, make_camera

ONE, FIRST_ROW = np.ones(1), np.zeros(1, dtype=np.int32)
START = np.array([0, 1], dtype=np.int64)
SHIFTS = np.array([[1.0, 0.0], [0.0, 1.0]])
"""Gradients are J' r: those of measurements one pixel apart differ by a row of J."""


@pytest.mark.parametrize(("projection", "distortion"), EVERY_MODEL)
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-6, 0.3, 1.2])
def test_reprojection_agrees_with_the_sensor_model_and_with_differences(
    projection: Projection, distortion: Distortion, offset: float
) -> None:
    model = make_camera(projection, distortion)
    T_G_I = se3.make(so3.exp([0.2, -0.4, 0.1]), [0.5, -0.2, 0.3])
    T_I_C = se3.make(so3.exp([-0.1, 0.3, 1.2]), [0.05, 0.02, -0.1])
    p_G = se3.transform(se3.compose(T_G_I, T_I_C), np.array([offset, -0.5 * offset, 2.0]))
    uv = np.array([300.0, 200.0])
    cameras = Cameras.of([model], T_I_C[None])
    at = VisualStates(T_G_I[None], cameras.T_I_C, cameras.parameters, p_G[None], np.zeros((1, 1)))

    def residual(delta: F64) -> F64:
        pose = se3.retract(T_G_I, delta[:6])
        p_C = se3.transform(se3.inverse(se3.compose(pose, T_I_C)), p_G + delta[6:])
        return np.asarray(project(model, p_C)[0]) - uv

    def data(uv: F64) -> VisualData:
        return VisualData(START, FIRST_ROW, FIRST_ROW, uv[None], ONE, ONE, np.zeros((0, 2)))

    def gradient(uv: F64) -> F64:
        kept = KeptSystem(
            np.zeros((1, 12), dtype=np.float32), np.zeros((1, 6)), np.zeros((1, 3)),
            np.zeros((1, 6)),
        )  # fmt: skip
        sums = PoseSums(np.zeros((1, 1, 6, 6)), np.zeros((1, 1, 6)))
        visual_kernels().keep_jacobians(
            data(uv), at, np.zeros((1, 4)), int(Loss.NONE), START, kept, sums, np.zeros(1)
        )
        return np.concatenate([sums.gradient[0, 0], kept.landmark_gradient[0]])

    error_depth = np.empty((1, 2))
    visual_kernels().evaluate(data(uv), at, error_depth)
    expected = residual(np.zeros(9))
    np.testing.assert_allclose(error_depth[0], [np.linalg.norm(expected), 2.0], atol=1e-9)
    jacobian = np.stack([gradient(uv - shift) - gradient(uv) for shift in SHIFTS])
    assert_relative(jacobian, differences(residual, 9))
    np.testing.assert_allclose(gradient(uv), jacobian.T @ expected, rtol=1e-7, atol=1e-6)


@pytest.mark.parametrize(("projection", "distortion"), EVERY_MODEL)
@pytest.mark.parametrize("inverse_depth", [1e-6, 0.1, 2.0])
def test_anchored_reprojection_agrees_with_the_sensor_model_and_with_differences(
    projection: Projection, distortion: Distortion, inverse_depth: float
) -> None:
    model = make_camera(projection, distortion)
    T_M_A = se3.make(so3.exp([0.2, -0.4, 0.1]), [0.5, -0.2, 0.3])
    T_M_I = se3.retract(T_M_A, [0.05, -0.1, 0.08, 0.1, -0.05, 0.15])
    T_I_CA = se3.make(so3.exp([-0.1, 0.3, 1.2]), [0.05, 0.02, -0.1])
    T_I_C = se3.retract(T_I_CA, [0.1, 0.0, 0.02, 0.02, -0.01, 0.03])
    h, uv = np.array([0.2, -0.1, inverse_depth]), np.array([300.0, 200.0])
    calibration = WindowCalibration.of((model, model), np.stack([T_I_CA, T_I_C]))
    poses = np.stack([T_M_A, T_M_I])

    def ray_C(delta: F64) -> F64:
        """Return the landmark in C times its inverse depth, by homogeneous coordinates."""
        x, y, w = h + delta[12:]
        T_M_C = se3.compose(se3.retract(T_M_I, delta[6:12]), T_I_C)
        T_M_CA = se3.compose(se3.retract(T_M_A, delta[:6]), T_I_CA)
        matrix = se3.to_matrix(se3.relative(T_M_C, T_M_CA))
        return np.asarray(matrix @ [x, y, 1.0, w])[:3]

    def residual(delta: F64) -> F64:
        return np.asarray(project(model, ray_C(delta))[0]) - uv

    def data(uv: F64) -> WindowData:
        second = np.ones(1, dtype=np.int32)
        return WindowData(
            START, second, second, uv[None], ONE, ONE, FIRST_ROW, FIRST_ROW, np.zeros((1, 2))
        )

    at = WindowPoint(poses, h[None], calibration.of_kernels(np.zeros(0)), np.zeros((0, 7)))

    def gradient(uv: F64) -> F64:
        system, kept = DenseSystem.zeros(2 * FRAME_SIZE), Elimination.empty(1, 2)
        rule = WindowRule(int(Loss.NONE), 1e-5, poses, np.array([False, False]))
        window_kernels().eliminate(data(uv), at, rule, system, kept)
        frames = system.gradient.reshape(2, FRAME_SIZE)[:, :6]
        return np.concatenate([frames.reshape(-1), kept.gradient[0]])

    error_depth = np.empty((1, 2))
    window_kernels().evaluate(data(uv), at, error_depth)
    expected = residual(np.zeros(15))
    assert error_depth[0, 0] == pytest.approx(np.linalg.norm(expected), abs=1e-9)
    assert error_depth[0, 1] == pytest.approx(ray_C(np.zeros(15))[2] / inverse_depth)
    jacobian = np.stack([gradient(uv - shift) - gradient(uv) for shift in SHIFTS])
    np.testing.assert_allclose(jacobian[:, :3], -jacobian[:, 6:9], atol=1e-9)
    assert_relative(jacobian, differences(residual, 15))


@pytest.mark.parametrize(("projection", "distortion"), EVERY_MODEL)
@pytest.mark.parametrize("is_same_frame", [False, True])
@pytest.mark.parametrize("lateness_s", [0.0, 0.02])
def test_window_jacobians_by_the_calibration_and_of_late_rows_are_those_of_differences(
    projection: Projection, distortion: Distortion, is_same_frame: bool, lateness_s: float
) -> None:
    model = make_camera(projection, distortion)
    T_I_C = se3.make(
        so3.exp([[-0.1, 0.3, 1.2], [-0.08, 0.3, 1.22]]), [[0.05, 0.02, -0.1], [0.1, 0, 0]]
    )
    calibration = WindowCalibration.of((model, model), T_I_C, CALIBRATED)
    values = 0.3 * calibration.sigma * np.cos(np.arange(len(calibration)))
    poses = np.stack([se3.identity(), se3.exp([0.05, -0.1, 0.08, 0.1, -0.05, 0.15])])
    twist = np.array([[0.3, -0.2, 0.1, 0.5, -0.4, 0.8, 0.0], [0.2, 0.1, -0.3, -0.6, 0.2, 0.5, 0.0]])
    twist[:, 6] = -lateness_s
    h, uv = np.array([0.2, -0.1, 0.4]), np.array([300.0, 200.0])
    frame = 0 if is_same_frame else 1
    size, seen = 12 + 3, np.array([frame], dtype=np.int32)

    def residual(delta: F64) -> F64:
        cameras = calibration.of_kernels(values + calibration.sigma * delta[size:])
        (x, y, w), body = h + delta[12:size], se3.retract(poses, delta[:12].reshape(2, 6))
        p_A = se3.transform(cameras.T_I_C[0], np.array([x, y, 1.0]) / w)
        p_I = se3.transform(se3.relative(body[frame], body[0]), p_A)
        late_s = cameras.timing_s[1] @ [1.0, uv[1]] - twist[frame, 6]
        turn = so3.skew(late_s * twist[frame, 3:6])
        p_I = (np.eye(3) - turn + 0.5 * turn @ turn) @ (p_I - late_s * twist[frame, :3])
        count, numbers = len(model.intrinsics), cameras.parameters[1, 1:]
        camera = dataclasses.replace(
            model,
            intrinsics=numbers[:count],
            distortion_parameters=numbers[count:][: len(model.distortion_parameters)],
        )
        return (
            np.asarray(project(camera, se3.transform(se3.inverse(cameras.T_I_C[1]), p_I))[0]) - uv
        )

    one = np.ones(1, dtype=np.int32)
    first = np.zeros(1, dtype=np.int32)

    def gradient(shift: F64) -> F64:
        count = len(calibration)
        system, kept = DenseSystem.zeros(2 * FRAME_SIZE + count), Elimination.empty(1, 2, count)
        rule = WindowRule(int(Loss.NONE), 1e-5, poses, np.array([False, False]))
        data = WindowData(
            START, seen, one, (uv + shift)[None], ONE, ONE, first, first, np.zeros((1, 2))
        )
        row = (
            data.uv_px[0, 1] - uv[1]
        )  # the row of the image moves with the measurement: not its time
        late = twist.copy()
        late[:, 6] += row * cameras.timing_s[1, 1]
        at = WindowPoint(poses, h[None], cameras, late)
        window_kernels().eliminate(data, at, rule, system, kept)
        frames = system.gradient[: 2 * FRAME_SIZE].reshape(2, FRAME_SIZE)[:, :6]
        line = [row for row, name in enumerate(calibration.names()) if name == "line delay"]
        of_calibration = system.gradient[2 * FRAME_SIZE :].copy()
        of_calibration[line] *= uv[1] / data.uv_px[0, 1]
        return np.concatenate([frames.reshape(-1), kept.gradient[0], of_calibration])

    cameras = calibration.of_kernels(values)
    jacobian = np.stack([gradient(-shift) - gradient(np.zeros(2)) for shift in SHIFTS])
    jacobian[:, size:] *= calibration.sigma
    expected = differences(residual, size + len(calibration))
    if is_same_frame:
        expected[:, :12] = 0.0  # the landmark moves with its anchor
    assert_relative(jacobian, expected)


def test_cameras_of_several_models_are_chosen_by_their_rows() -> None:
    models = [make_camera(*model) for model in EVERY_MODEL]
    count = len(models)
    cameras = Cameras.of(models, se3.identity(count))
    rows = np.zeros(count, dtype=np.int32), np.arange(count, dtype=np.int32)
    uv, p_G, one = np.full((count, 2), 50.0), np.array([[0.4, -0.2, 1.0]]), np.ones(count)
    start = np.array([0, count], dtype=np.int64)
    data = VisualData(start, *rows, uv, one, one, np.zeros((0, 2)))
    at = VisualStates(se3.identity(1), cameras.T_I_C, cameras.parameters, p_G, np.zeros((count, 1)))
    result = np.empty((count, 2))
    visual_kernels().evaluate(data, at, result)
    expected = [float(np.linalg.norm(project(model, p_G[0])[0] - 50.0)) for model in models]
    np.testing.assert_allclose(result, np.stack([expected, np.ones(count)], axis=1), rtol=1e-12)
    assert len({round(error, 6) for error in expected}) == count


def _random_tracks(seed: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    tracks = [np.sort(rng.integers(0, 10, rng.integers(0, 7))) for _ in range(40)]
    start = starts_of_counts(np.array([len(track) for track in tracks]))
    return tracks, start, np.concatenate(tracks).astype(np.int32)


@pytest.mark.parametrize("seed", range(5))
def test_every_pair_has_its_block(seed: int) -> None:
    num_vertices = 12  # two of which see nothing
    tracks, start, vertex = _random_tracks(seed)
    plan = elimination_plan(start, vertex, num_vertices)
    pairs = [
        (track[b], track[a]) for track in tracks for b in range(len(track)) for a in range(b + 1)
    ]
    wanted = sorted({(int(b), int(a)) for b, a in pairs} | {(v, v) for v in range(num_vertices)})
    assert list(zip(plan.rows.tolist(), plan.cols.tolist(), strict=True)) == wanted


@pytest.mark.parametrize("seed", range(5))
def test_all_work_is_shared_out_once(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visual_structure, "_SMALL_SLAB", 20)
    _, start, vertex = _random_tracks(seed)
    plan = elimination_plan(start, vertex, 12)
    assert len(plan.slab_start) > 4
    assert plan.largest_slab == np.diff(start[plan.slab_start]).max()
    np.testing.assert_array_equal(plan.chunk_start[:, 0], plan.slab_start[:-1])
    np.testing.assert_array_equal(plan.chunk_start[:, -1], plan.slab_start[1:])
    assert (np.diff(plan.chunk_start, axis=1) >= 0).all()
    assert (np.diff(plan.piece_start, axis=1) >= 0).all()
    np.testing.assert_array_equal(plan.piece_start[:, [0, -1]], [[0, 12]] * len(plan.piece_start))
    np.testing.assert_array_equal(np.sort(plan.views), np.arange(len(vertex)))
    _check_views(plan, start, vertex)


def _check_views(plan: EliminationPlan, start: np.ndarray, vertex: np.ndarray) -> None:
    for slab, offsets in enumerate(plan.view_start):
        low, high = start[plan.slab_start[slab]], start[plan.slab_start[slab + 1]]
        assert (offsets[0], offsets[-1]) == (low, high)
        for v in range(len(offsets) - 1):
            wanted = low + np.flatnonzero(vertex[low:high] == v)
            np.testing.assert_array_equal(plan.views[offsets[v] : offsets[v + 1]], wanted)


def test_no_landmarks_leave_the_diagonal() -> None:
    plan = elimination_plan(np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int32), 3)
    np.testing.assert_array_equal(plan.rows, [0, 1, 2])
    np.testing.assert_array_equal(plan.cols, [0, 1, 2])
    assert plan.largest_slab == 0
