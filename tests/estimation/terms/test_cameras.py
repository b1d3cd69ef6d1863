"""Cameras, terms and symbolic residuals: derivatives against finite differences."""

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from maplab_py.estimation import blocks, loss
from maplab_py.estimation.codegen.kernels import residual_kernel, visual_kernels
from maplab_py.estimation.imu.inertial_data import InertialData, VertexMotion
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import ACCEL_BIAS, GYRO_BIAS, VELOCITY, States
from maplab_py.estimation.symbolic import sources
from maplab_py.estimation.symbolic.sources import absolute_pose, inertial, relative_pose
from maplab_py.estimation.terms import inertial_calibration, protocol, wheel
from maplab_py.estimation.terms.cameras import EXTRINSICS, Cameras, camera_blocks
from maplab_py.estimation.terms.pose import (
    SWITCH,
    AbsolutePoseTerm,
    Mounting,
    RelativePoseTerm,
    SwitchedRelativePoseTerm,
    mounting_block,
    switch_block,
)
from maplab_py.estimation.terms.prior import BlockPrior, PosePrior, VertexVectorPrior
from maplab_py.estimation.terms.visual import Observations, VisualTerms
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Distortion, Imu, Projection, camera
from maplab_py.sensors.imu import ImuIntrinsics
from tests.estimation.dense import (
    assert_relative,
    differences,
    numeric_jacobian,
    numeric_point_jacobian,
    system_matrix,
    term_jacobian,
)
from tests.estimation.imu.motion import sampled
from tests.support.scene import EVERY_MODEL, make_camera

F64 = NDArray[np.float64]

TWO_MODELS = ((Projection.PINHOLE, Distortion.FOV), (Projection.PINHOLE, Distortion.RADTAN))
VERTICES, LANDMARKS, INVERSE_SIGMA, SCALE2 = 4, 12, 1.3, 9.0


@dataclasses.dataclass
class Scene:
    visual: VisualTerms
    states: States
    problem: Problem
    models: tuple[tuple[Projection, Distortion], ...]

    def residual(self, states: States) -> F64:
        """Signed residuals [sigmas] from the errors for three shifted measurements."""
        measured = self.visual.observations
        squared = []
        for shift in ([0.0, 0.0], [1.0, 0.0], [0.0, 1.0]):
            self.visual.use(dataclasses.replace(measured, uv_px=measured.uv_px - shift))
            squared.append(self.visual.errors(states)[0] ** 2)
        self.visual.use(measured)
        x, y = (0.5 * (squared[k] - squared[0] - 1.0) for k in (1, 2))
        return INVERSE_SIGMA * np.stack([x, y], axis=1)


@pytest.fixture(scope="module", params=[False, True], ids=["offset", "rows"])
def scene(request: pytest.FixtureRequest) -> Scene:
    """Return a rig whose calibration is estimated, with line delays or without."""
    return make_scene(TWO_MODELS, line_delays=request.param)


def make_scene(models: tuple[tuple[Projection, Distortion], ...], *, line_delays: bool) -> Scene:
    size = len(models)
    rng = np.random.default_rng(0)
    T_G_I = se3.make(so3.exp(rng.normal(0, 0.05, (VERTICES, 3))), rng.normal(0, 0.2, (VERTICES, 3)))
    T_I_C = se3.make(so3.exp(rng.normal(0, 0.1, (size, 3))), rng.normal(0, 0.05, (size, 3)))
    cameras = Cameras.of([make_camera(*model) for model in models], T_I_C)
    count = LANDMARKS * VERTICES * size
    observations = Observations(
        start=np.arange(LANDMARKS + 1) * VERTICES * size,
        vertex=np.tile(np.repeat(np.arange(VERTICES), size), LANDMARKS).astype(np.int32),
        camera=np.tile(np.arange(size), LANDMARKS * VERTICES).astype(np.int32),
        uv_px=rng.uniform(200, 400, (count, 2)),
        inverse_sigma=np.full(count, INVERSE_SIGMA),
        loss_scale=np.full(count, np.sqrt(SCALE2)),
    )
    visual = VisualTerms(
        visual_kernels(), observations, cameras, VERTICES, loss=loss.Loss.CAUCHY, estimate_cameras=True,
        estimate_line_delays=line_delays,
    )  # fmt: skip
    points = rng.uniform([-1, -1, 3], [1, 1, 5], (LANDMARKS, 3))
    zero = np.zeros((VERTICES, 3))
    states = States(T_G_I, rng.normal(0, 1, (VERTICES, 3)), zero, zero, points)
    timing_s = rng.normal(0.0, [0.01, 3e-5], (size, 2))[:, : 2 if line_delays else 1]
    states = states.with_blocks(*camera_blocks(cameras, timing_s))
    scene = Scene(visual, states, Problem(states, visual, ()), models)
    # measured near the projections: a step that the landmarks' curvature spoils is refined
    predicted_px = observations.uv_px + scene.residual(states) / INVERSE_SIGMA
    noise_px = rng.normal(0.0, 1.0, (count, 2))
    visual.use(dataclasses.replace(observations, uv_px=predicted_px + noise_px))
    visual.follow_motion(turning(rng.normal(0, 1, (VERTICES, 3))))
    visual.refresh(states)
    return scene


def turning(rate_I: F64) -> VertexMotion:
    """Return vertices (V, 3) that turn and are accelerated."""
    change = np.random.default_rng(3).normal(0, 1, (2, *rate_I.shape))
    return VertexMotion(rate_I, change[0], change[1])


@pytest.fixture(scope="module")
def dense(scene: Scene) -> tuple[F64, F64]:
    return dense_equations(scene)


def dense_equations(scene: Scene) -> tuple[F64, F64]:
    """Return weighted residuals and Jacobian by nodes, then landmarks."""
    residual = scene.residual(scene.states)
    weight = np.sqrt(1.0 / (1.0 + (residual**2).sum(axis=1) / SCALE2))
    by_node = numeric_jacobian(scene.residual, scene.states, 1e-5)
    by_point = numeric_point_jacobian(scene.residual, scene.states, 1e-5)
    jacobian = np.concatenate([by_node, by_point], axis=1)
    return (residual * weight[:, None]).reshape(-1), jacobian * np.repeat(weight, 2)[:, None]


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_the_reduced_system_is_the_schur_complement(
    scene: Scene, dense: tuple[F64, F64], damping: float
) -> None:
    assert_is_schur_complement(scene, dense, damping)


def test_a_rig_of_all_models_is_estimated_by_the_same_kernels() -> None:
    scene = make_scene(EVERY_MODEL, line_delays=True)
    r, J = dense_equations(scene)
    assert_is_schur_complement(scene, (r, J), 1e-3)
    # every column on its own scale
    linear = scene.problem.linearize(scene.states, 1e-3)
    diagonal = np.einsum("rc,rc->c", J, J)[: 3 * scene.states.num_nodes]
    np.testing.assert_allclose(linear.diagonal.reshape(-1), diagonal, rtol=1e-5, atol=1e-12)


def assert_is_schur_complement(scene: Scene, dense: tuple[F64, F64], damping: float) -> None:
    r, J = dense
    nodes = 3 * scene.states.num_nodes
    H = J.T @ J
    H += damping * np.diag(np.clip(np.diag(H), 1e-6, 1e32))
    landmark_part = H[:nodes, nodes:] @ np.linalg.inv(H[nodes:, nodes:])
    wanted = H[:nodes, :nodes] - landmark_part @ H[nodes:, :nodes]
    g = J.T @ r
    linear = scene.problem.linearize(scene.states, damping)
    found = system_matrix(scene.problem, linear, damping)
    np.testing.assert_allclose(found, wanted, atol=1e-7 * np.abs(wanted).max())
    reduced = g[:nodes] - landmark_part @ g[nodes:]
    np.testing.assert_allclose(
        linear.gradient.reshape(-1), reduced, atol=1e-7 * np.abs(reduced).max()
    )


def test_a_step_moves_landmarks_as_dense_algebra_does(scene: Scene, dense: tuple[F64, F64]) -> None:
    r, J = dense
    damping, nodes = 1e-3, 3 * scene.states.num_nodes
    H = J.T @ J
    damped = H + damping * np.diag(np.clip(np.diag(H), 1e-6, 1e32))
    wanted = np.linalg.solve(damped, -J.T @ r)
    step = scene.problem.solve(scene.problem.linearize(scene.states, damping), damping)
    moved = scene.states.moved(step, scene.states.p_G)
    p_G, cost, promised = scene.visual.take_step(scene.states, step, moved, damping)
    np.testing.assert_allclose(step.reshape(-1), wanted[:nodes], atol=1e-4 * np.abs(wanted).max())
    np.testing.assert_allclose(
        (p_G - scene.states.p_G).reshape(-1), wanted[nodes:], atol=1e-4 * np.abs(wanted).max()
    )
    assert promised == pytest.approx(-(wanted @ J.T @ r + 0.5 * wanted @ H @ wanted), rel=1e-5)
    error_px = scene.visual.errors(dataclasses.replace(moved, p_G=p_G))[0]
    rho = SCALE2 * np.log1p((INVERSE_SIGMA * error_px) ** 2 / SCALE2)
    assert cost == pytest.approx(0.5 * rho.sum(), rel=1e-12)


def test_padding_of_narrow_cameras_has_no_effect(scene: Scene) -> None:
    linear = scene.problem.linearize(scene.states, 0.0)
    intrinsics = scene.states.nodes("camera intrinsics")
    diagonal = linear.diagonal[intrinsics].reshape(len(intrinsics), -1)
    for row, (projection, distortion) in enumerate(scene.models):
        size = camera.INTRINSICS_SIZE[projection] + camera.DISTORTION_SIZE[distortion]
        assert diagonal[row, :size].all()
        assert not diagonal[row, size:].any()
    offset = scene.states.nodes("camera timing").reshape(-1)
    used = scene.states.blocks["camera timing"].dimension
    assert linear.diagonal[offset, :used].all()
    assert not linear.diagonal[offset, used:].any()


def test_without_velocities_time_offsets_change_nothing(scene: Scene) -> None:
    still = dataclasses.replace(scene.states, v_G=np.zeros((VERTICES, 3)))
    before = scene.visual.errors(scene.states)[0]
    scene.visual.follow_motion(VertexMotion.still(VERTICES))
    scene.visual.refresh(still)
    assert not np.array_equal(scene.visual.errors(still)[0], before)
    linear = scene.problem.linearize(still, 0.0)
    assert not linear.diagonal[still.nodes("camera timing")].any()
    scene.visual.follow_motion(turning(np.random.default_rng(1).normal(0, 1, (VERTICES, 3))))
    scene.visual.refresh(scene.states)


def test_pixels_move_as_far_as_their_vertices_that_are_accelerated() -> None:
    """What a delay adds to a residual is the way of the projection, not that at a constant velocity."""
    scene, rng = make_scene(TWO_MODELS, line_delays=True), np.random.default_rng(4)
    motion, measured = turning(rng.normal(0, 1, (VERTICES, 3))), scene.visual.observations
    delay_s = np.full(VERTICES, 0.02)
    T_G_I, _ = motion.after(delay_s, scene.states.T_G_I, scene.states.v_G)
    now, then = (
        dataclasses.replace(scene.states, T_G_I=poses).with_blocks(
            dataclasses.replace(scene.states.blocks["camera timing"], values=np.full((2, 2), delay))
        )
        for poses, delay in ((scene.states.T_G_I, [0.02, 0.0]), (T_G_I, [0.0, 0.0]))
    )
    errors = []
    for of_motion in (motion, VertexMotion(motion.rate_I, *np.zeros((2, VERTICES, 3)))):
        scene.visual.follow_motion(of_motion)
        scene.visual.refresh(now)
        errors.append(scene.residual(now) - scene.residual(then))
    assert len(errors[0]) == len(measured)
    assert np.abs(errors[0]).max() < 0.02
    assert np.abs(errors[1]).max() > 0.1


def test_known_delays_move_measurements_of_any_kernels(scene: Scene) -> None:
    """Kernels without cameras see what those that estimate cameras see at the same delays."""
    measured, rng = scene.visual.observations, np.random.default_rng(2)
    timing_s = scene.states.blocks["camera timing"].values
    delay_s = timing_s[measured.camera, 0].copy()
    if timing_s.shape[1] > 1:
        delay_s += timing_s[measured.camera, 1] * measured.uv_px[:, 1]
    cameras = Cameras.of(
        [make_camera(*model) for model in scene.models],
        scene.states.blocks["camera extrinsics"].values,
    )
    plain = VisualTerms(visual_kernels(), measured, cameras, VERTICES, loss=loss.Loss.CAUCHY)
    velocity = rng.normal(0, 1, (VERTICES, 3))
    plain.follow_motion(turning(velocity), delay_s)
    assert plain.refresh(scene.states)
    scene.visual.follow_motion(turning(velocity))
    scene.visual.refresh(scene.states)
    np.testing.assert_allclose(
        plain.errors(scene.states)[0], scene.visual.errors(scene.states)[0], rtol=1e-12
    )
    without = VisualTerms(visual_kernels(), measured, cameras, VERTICES, loss=loss.Loss.CAUCHY)
    assert not without.refresh(scene.states)
    assert np.abs(without.errors(scene.states)[0] - plain.errors(scene.states)[0]).max() > 0.1


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def states(rng: np.random.Generator, vertices: int = 3) -> States:
    def vectors(scale: float) -> np.ndarray:
        return rng.normal(0, scale, (vertices, 3))

    poses = se3.make(so3.exp(vectors(1.0)), vectors(2.0))
    return States(poses, vectors(1.0), vectors(0.01), vectors(0.1), np.zeros((0, 3)))


def check(
    term: protocol.FactorTerm, at: States, step: float = 1e-6, tolerance: float = 1e-6
) -> None:
    found = term_jacobian(term, at)
    wanted = numeric_jacobian(lambda moved: term.evaluate(moved)[0], at, step)
    np.testing.assert_allclose(found, wanted, atol=tolerance * np.abs(wanted).max())


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.4])
def test_inertial_edges_with_imu_intrinsics(rng: np.random.Generator, angle: float) -> None:
    intrinsics = ImuIntrinsics(
        T_g=np.array([[1.01, 0.02, -0.01], [0, 0.98, 0.015], [0, 0, 1.03]]),
        T_a=np.array([[0.97, -0.01, 0.02], [0, 1.02, 0.01], [0, 0, 0.99]]),
        R_A_I=so3.to_matrix(so3.exp(np.array([0.3, -0.2, 1.0]) * angle)),
    )
    imu = Imu("0" * 32, intrinsics=intrinsics)
    stamps, readings = sampled(0.3, 200)
    data = InertialData(
        np.array([0, 31, 61]), stamps, readings, (imu,), np.zeros(2, dtype=np.int64)
    )
    at = states(rng).with_blocks(*inertial_calibration.imu_blocks((imu,)))
    kernel = residual_kernel("inertial_with_intrinsics", sources.inertial_with_intrinsics)
    first, second = np.array([0, 1]), np.array([1, 2])
    gravity = np.tile([0.0, 0.0, -9.81], (2, 1))
    term = inertial_calibration.CalibratingInertialTerm(kernel, data, first, second, gravity, at)
    term.relinearize(at)
    check(term, at)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1.0])
def test_poses_of_mounted_sensors(rng: np.random.Generator, angle: float) -> None:
    T_I_S = se3.make(so3.exp(angle * rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    at = states(rng).with_blocks(mounting_block(T_I_S))
    W = rng.normal(size=(2, 6, 6))
    mounting = Mounting.of(at, np.array([1, 0]))
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    relative = residual_kernel("relative_pose_with_mounting", sources.relative_pose_with_mounting)
    ends = np.array([0, 1]), np.array([1, 2])
    check(RelativePoseTerm(relative, "odometry", *ends, T_I_S, measured, W, mounting=mounting), at)
    absolute = residual_kernel("absolute_pose_with_mounting", sources.absolute_pose_with_mounting)
    check(AbsolutePoseTerm(absolute, ends[0], T_I_S, measured, W, mounting=mounting), at)


@pytest.mark.parametrize("has_mounting", [False, True])
def test_wheels_of_unknown_scale(rng: np.random.Generator, has_mounting: bool) -> None:
    T_I_S = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    at = states(rng).with_blocks(
        mounting_block(T_I_S), wheel.wheel_scale_block(np.array([1.02, 0.9]))
    )
    W = rng.normal(size=(2, 6, 6))
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    name = "scaled_relative_pose" + ("_with_mounting" if has_mounting else "")
    kernel = residual_kernel(name, getattr(sources, name))
    mounting = Mounting.of(at, np.array([1, 0])) if has_mounting else None
    ends = np.array([0, 1]), np.array([1, 2])
    poses = RelativePoseTerm(kernel, "wheels", *ends, T_I_S, measured, W, mounting=mounting)
    sensor = np.array([1, 0])
    check(wheel.ScaledRelativePoseTerm(poses, sensor, at.nodes(wheel.WHEEL_SCALE)[sensor]), at)


def test_switched_relative_poses(rng: np.random.Generator) -> None:
    at = states(rng).with_blocks(switch_block(np.array([0.7, 0.3])))
    kernel = residual_kernel("switched_relative_pose", sources.switched_relative_pose)
    measured = se3.make(so3.exp(rng.normal(size=(2, 3))), rng.normal(size=(2, 3)))
    W = rng.normal(size=(2, 6, 6))
    rows = np.array([0, 1])
    term = SwitchedRelativePoseTerm(
        kernel, "loop", np.array([0, 1]), np.array([2, 2]), measured, W, rows, at.nodes(SWITCH)
    )
    check(term, at)


@pytest.mark.parametrize("manifold", list(blocks.Manifold))
def test_priors_of_blocks(rng: np.random.Generator, manifold: blocks.Manifold) -> None:
    tangent = rng.normal(0, 0.8, (3, 6))
    values = {
        blocks.Manifold.VECTOR: tangent[:, :4],
        blocks.Manifold.POSE: se3.make(so3.exp(tangent[:, 3:]), tangent[:, :3]),
        blocks.Manifold.ROTATION: so3.exp(tangent[:, :3]),
    }[manifold]
    at = states(rng).with_blocks(blocks.ParameterBlock("thing", values, manifold))
    size = at.blocks["thing"].dimension
    reference = at.blocks["thing"].moved(rng.normal(0, 0.5, (at.blocks["thing"].num_nodes, 3)))
    root = rng.normal(size=(2, size, size))
    rows = np.array([2, 0])
    check(BlockPrior(at, "thing", reference.values[rows], root, rows), at)


def test_priors_of_vertices(rng: np.random.Generator) -> None:
    at = states(rng)
    rows = np.array([2, 1])
    near = se3.retract(at.T_G_I[rows], rng.normal(0, 0.7, (2, 6)))
    check(PosePrior(rows, near, rng.normal(size=(2, 6, 6))), at)
    for kind in (VELOCITY, GYRO_BIAS, ACCEL_BIAS):
        check(VertexVectorPrior(kind, rows, rng.normal(size=(2, 3)), 0.3), at)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.5, 2.0])
def test_inertial_jacobian(scale: float) -> None:
    rng = np.random.default_rng(3)
    kernel = residual_kernel("inertial", inertial)
    T_A = se3.make(so3.exp([0.3, -0.2, 0.8]), [1.0, 2.0, 3.0])
    T_B = se3.make(so3.multiply(T_A[:4], so3.exp(scale * np.array([1.0, -0.5, 0.2]))), [1.1, 2, 3])
    v_A, v_B = np.array([1.0, 0.1, 0.0]), np.array([1.1, 0.0, 0.1])
    fixed = np.concatenate(
        [
            so3.exp(0.9 * scale * np.array([1.0, -0.4, 0.3])),
            rng.normal(size=6) * 0.1,
            rng.normal(size=54) * 0.1,
            rng.normal(size=6) * 0.01,
            [0.1, 0.0, 0.0, -9.81],
        ]
    )

    def residual(delta: np.ndarray) -> np.ndarray:
        a, b = se3.retract(T_A, delta[:6]), se3.retract(T_B, delta[15:21])
        moving = [a, v_A + delta[6:9], 0.01 + delta[9:12], 0.02 + delta[12:15], b, v_B + delta[21:]]
        return evaluate(kernel, np.concatenate([*moving, fixed]), 9, 24)[0]

    zero = np.concatenate([T_A, v_A, np.full(3, 0.01), np.full(3, 0.02), T_B, v_B, fixed])
    jacobian = evaluate(kernel, zero, 9, 24)[1]
    assert_relative(jacobian, differences(residual, 24))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 0.4, 3.0])
def test_pose_jacobians(angle: float) -> None:
    T_A = se3.make(so3.exp([0.3, -0.2, 0.8]), [1.0, 2.0, 3.0])
    T_B = se3.make(so3.exp([0.1, 0.5, 0.7]), [1.5, 2.2, 2.9])
    T_I_S = se3.make(so3.exp([0.2, 0.1, -0.4]), [0.1, 0.2, -0.1])
    off = se3.make(so3.exp(angle * np.array([0.6, -0.8, 0.0])), [0.02, 0.0, -0.01])
    S_A, S_B = se3.compose(T_A, T_I_S), se3.compose(T_B, T_I_S)
    relative = residual_kernel("relative_pose", relative_pose)
    absolute = residual_kernel("absolute_pose", absolute_pose)
    measured = se3.compose(se3.relative(S_A, S_B), off)
    measured_G = se3.compose(S_A, off)

    def of_relative(delta: np.ndarray) -> np.ndarray:
        poses = [se3.retract(T_A, delta[:6]), se3.retract(T_B, delta[6:])]
        return evaluate(relative, np.concatenate([*poses, T_I_S, measured]), 6, 12)[0]

    def of_absolute(delta: np.ndarray) -> np.ndarray:
        pose = se3.retract(T_A, delta)
        return evaluate(absolute, np.concatenate([pose, T_I_S, measured_G]), 6, 6)[0]

    jacobian = evaluate(relative, np.concatenate([T_A, T_B, T_I_S, measured]), 6, 12)[1]
    assert_relative(jacobian, differences(of_relative, 12))
    jacobian = evaluate(absolute, np.concatenate([T_A, T_I_S, measured_G]), 6, 6)[1]
    assert_relative(jacobian, differences(of_absolute, 6))
    expected = angle * np.array([-0.6, 0.8, 0.0])
    np.testing.assert_allclose(of_absolute(np.zeros(6))[3:], expected, atol=1e-12)


def evaluate(kernel: object, x: np.ndarray, size: int, columns: int) -> tuple[np.ndarray, ...]:
    residual, jacobian = np.empty((1, size)), np.empty((1, size, columns))
    kernel.evaluate(x[None], np.eye(size)[None], residual, jacobian)  # type: ignore[attr-defined]
    return residual[0], jacobian[0]


def test_a_landmark_whose_step_overshoots_is_refined() -> None:
    free = make_scene(TWO_MODELS, line_delays=False)
    cameras = Cameras.of(
        [make_camera(*model) for model in TWO_MODELS], free.states.blocks[EXTRINSICS].values
    )
    visual = VisualTerms(
        visual_kernels(), free.visual.observations, cameras, VERTICES, loss=loss.Loss.CAUCHY
    )
    zero = np.zeros((VERTICES, 3))
    states = States(free.states.T_G_I, zero, zero, zero, 3.0 * free.states.p_G)
    r, J = dense_equations(Scene(visual, states, Problem(states, visual, ()), TWO_MODELS))
    nodes = 3 * states.num_nodes
    step = np.linalg.solve(J[:, nodes:].T @ J[:, nodes:], -J[:, nodes:].T @ r).reshape(-1, 3)
    plain = dataclasses.replace(states, p_G=states.p_G + step)
    held = np.zeros((states.num_nodes, 3))
    p_G, cost, _ = visual.take_step(states, held, states, 0.0)
    assert cost < 0.9 * visual.cost(plain)
    refined = dataclasses.replace(states, p_G=p_G)
    assert cost == pytest.approx(visual.cost(refined), rel=1e-12)
