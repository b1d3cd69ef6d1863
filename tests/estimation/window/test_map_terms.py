"""Observations of a map against numeric derivatives, dense elimination, and the general solver."""

import dataclasses

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.estimation.codegen.kernels import window_kernels
from maplab_py.estimation.kernels import map_observations as kernels
from maplab_py.estimation.kernels.window_arguments import DenseSystem
from maplab_py.estimation.window import localized, warmup
from maplab_py.estimation.window.alignment import aligned
from maplab_py.estimation.window.map_terms import MapObservations, MapTerms
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Distortion, Projection
from maplab_py.sensors.projection import project

FRAMES, LANDMARKS = 3, 6
T_G_M = se3.make(so3.exp([0.02, -0.01, 0.7]), [3.0, -2.0, 0.5])
WEAK = np.repeat([4.0, 1.0], 3)


def rig() -> tuple[tuple[Camera, ...], F64]:
    pinhole = Camera(
        "0" * 32, Projection.PINHOLE, Distortion.RADTAN,
        np.array([380.0, 385.0, 376.0, 240.0]), np.array([-0.28, 0.07, 2e-4, 2e-5]), 752, 480,
    )  # fmt: skip
    unified = Camera(
        "1" * 32, Projection.UNIFIED, Distortion.EQUIDISTANT,
        np.array([0.9, 400.0, 400.0, 376.0, 240.0]), np.array([0.01, 0.002, 1e-3, 1e-4]), 752, 480,
    )  # fmt: skip
    T_I_C = se3.make(so3.exp([[0.1, 0.2, -0.1], [0.0, 0.3, 0.1]]), [[0.1, 0, 0.02], [-0.1, 0, 0]])
    return (pinhole, unified), T_I_C


def window(
    *, noise_px: float = 0.5, knows_landmarks: bool = True, seed: int = 3
) -> tuple[MapTerms, WindowStates]:
    """Return a small window that observes a map with both cameras, at its true states."""
    rng = np.random.default_rng(seed)
    cameras, T_I_C = rig()
    T_M_I = se3.make(
        so3.exp(0.1 * rng.standard_normal((FRAMES, 3))), 0.3 * rng.standard_normal((FRAMES, 3))
    )
    p_M = rng.uniform([-1.5, -1.0, 4.0], [1.5, 1.0, 7.0], (LANDMARKS, 3))
    landmark, frame, camera = (
        x.reshape(-1) for x in np.indices((LANDMARKS, FRAMES, 2)).astype(np.int32)
    )
    uv_px = np.empty((len(frame), 2))
    for row, model in enumerate(cameras):
        mine = camera == row
        p_I = se3.transform(se3.inverse(T_M_I[frame[mine]]), p_M[landmark[mine]])
        uv_px[mine], visible = project(model, se3.transform(se3.inverse(T_I_C[row]), p_I))
        assert visible.all()
    uv_px += noise_px * rng.standard_normal(uv_px.shape)
    p_G = se3.transform(T_G_M, p_M)
    information = None
    if not knows_landmarks:
        root = rng.standard_normal((LANDMARKS, 3, 3))
        information = 1e3 * (root @ root.transpose(0, 2, 1) + np.eye(3))
    start = np.arange(0, len(frame) + 1, 2 * FRAMES, dtype=np.int64)
    observations = MapObservations(
        start, frame, camera, uv_px, np.full(len(frame), 0.8), p_G, information
    )
    terms = MapTerms(
        observations, cameras, T_I_C, huber_sigmas=1.345, tilt_sigma_rad=float(np.radians(0.5))
    )
    moved = p_G + (0.0 if knows_landmarks else 0.02) * rng.standard_normal(p_G.shape)
    nothing = np.zeros((FRAMES, 9))
    return terms, WindowStates(T_M_I, nothing, np.zeros((0, 3)), T_G_M[None], moved)


def moved(states: WindowStates, step: F64) -> WindowStates:
    """Apply a step of frames and base frame (15 F + 6,), then of landmarks (3 A,)."""
    size = 15 * len(states) + 6
    p_G = states.p_G + step[size:].reshape(-1, 3)
    return dataclasses.replace(states.moved(step[:size], states.h), p_G=p_G)


@pytest.mark.parametrize("seed", [3, 4])
def test_jacobians_are_those_of_differences(seed: int) -> None:
    terms, states = window(seed=seed)
    now = terms.evaluate(states.T_M_I, states.T_G_M[0], states.p_G)
    assert now.is_visible.all()
    frame, landmark, h = terms.observations.frame, terms.observations.landmark, 1e-6
    for column in range(6):
        d = np.zeros(6)
        d[column] = h
        for first, poses, base in (
            (0, lambda s, d=d: se3.retract(states.T_M_I, s * d), lambda s: T_G_M),
            (6, lambda s: states.T_M_I, lambda s, d=d: se3.retract(T_G_M, s * d)),
        ):
            ahead, behind = (
                terms.evaluate(poses(s), base(s), states.p_G).residual for s in (1.0, -1.0)
            )
            numeric = (ahead - behind) / (2.0 * h)
            np.testing.assert_allclose(now.jacobian[:, :, first + column], numeric, atol=2e-4)
    for column in range(3):
        d = np.zeros((LANDMARKS, 3))
        d[:, column] = h
        ahead, behind = (
            terms.evaluate(states.T_M_I, T_G_M, states.p_G + s * d).residual for s in (1.0, -1.0)
        )
        numeric = (ahead - behind) / (2.0 * h)
        np.testing.assert_allclose(now.jacobian[:, :, 12 + column], numeric, atol=2e-4)
    assert len(frame) == len(landmark) == 2 * FRAMES * LANDMARKS


def test_gradient_is_the_derivative_of_the_cost() -> None:
    terms, states = window(knows_landmarks=False)
    system = DenseSystem.zeros(15 * FRAMES + 6)
    kept, costs = terms.add_to(system, states, states)
    assert kept is not None
    assert set(costs) == {"map", "map tilt", "map landmarks"}
    gradient = np.concatenate([system.gradient, kept.gradient.reshape(-1)])
    for k in np.flatnonzero(gradient):
        step = np.zeros(len(gradient))
        step[k] = 1e-6
        ahead, behind = (sum(terms.costs(moved(states, s * step)).values()) for s in (1, -1))
        assert gradient[k] == pytest.approx((ahead - behind) / 2e-6, rel=1e-4, abs=1e-3)


def test_elimination_is_that_of_the_whole_system() -> None:
    """The whole system has landmarks as columns; its Schur complement is what the window gets."""
    terms, states = window(knows_landmarks=False)
    system = DenseSystem.zeros(15 * FRAMES + 6)
    kept, _ = terms.add_to(system, states, states)
    assert kept is not None
    size = 15 * FRAMES + 6
    W = np.zeros((size, 3 * LANDMARKS))
    for a in range(LANDMARKS):
        W[kept.columns, 3 * a : 3 * a + 3] = kept.coupling[a].T
    H = np.zeros((3 * LANDMARKS, 3 * LANDMARKS))
    for a in range(LANDMARKS):
        H[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] = kept.square[a]
    known, known_states = window()
    whole = DenseSystem.zeros(size)
    exact = dataclasses.replace(terms.observations, information_G=None, p_G=states.p_G)
    known = MapTerms(exact, *rig(), huber_sigmas=1.345, tilt_sigma_rad=float(np.radians(0.5)))
    known.add_to(whole, known_states, known_states)
    np.testing.assert_allclose(
        np.tril(system.matrix),
        np.tril(whole.matrix - W @ np.linalg.solve(H, W.T)),
        atol=1e-6,
        rtol=1e-8,
    )
    g = kept.gradient.reshape(-1)
    np.testing.assert_allclose(system.reduced_gradient, -W @ np.linalg.solve(H, g), atol=1e-6)
    step = np.random.default_rng(1).standard_normal(size) * 1e-3
    p_G, promised = kept.step(states.p_G, step)
    dl = -np.linalg.solve(H, g + W.T @ step)
    np.testing.assert_allclose((p_G - states.p_G).reshape(-1), dl, atol=1e-12)
    assert promised == pytest.approx(-0.5 * g @ dl)


def test_landmarks_that_are_certain_are_exact_ones() -> None:
    terms, states = window(knows_landmarks=False)
    sure = dataclasses.replace(
        terms.observations, information_G=np.tile(1e15 * np.eye(3), (LANDMARKS, 1, 1))
    )
    exact = dataclasses.replace(sure, information_G=None)
    at_map = dataclasses.replace(states, p_G=sure.p_G)
    systems = []
    for observations in (sure, exact):
        system = DenseSystem.zeros(15 * FRAMES + 6)
        MapTerms(observations, *rig(), huber_sigmas=1.345).add_to(system, at_map, at_map)
        systems.append(system)
    np.testing.assert_allclose(systems[0].matrix, systems[1].matrix, atol=1e-3)


def test_shifting_the_mission_frame_changes_nothing() -> None:
    """Position and yaw of M are free: residuals and equations have that null space."""
    tilted, states = window()
    terms = MapTerms(tilted.observations, *rig(), huber_sigmas=1.345)
    T_N_M = se3.make(so3.exp([0.0, 0.0, 1.1]), [2.0, 3.0, -1.0])
    shifted = dataclasses.replace(
        states,
        T_M_I=se3.compose(T_N_M, states.T_M_I),
        T_G_M=se3.compose(states.T_G_M, se3.inverse(T_N_M)),
    )
    cost, other = terms.costs(states), terms.costs(shifted)
    assert cost == pytest.approx(other, rel=1e-9)
    system = DenseSystem.zeros(15 * FRAMES + 6)
    terms.add_to(system, states, states)
    null = np.zeros((15 * FRAMES + 6, 4))
    R_M_I, R_G_M = so3.to_matrix(states.T_M_I[:, :4]), so3.to_matrix(T_G_M[:4])
    for k in range(FRAMES):
        null[15 * k : 15 * k + 3, :3] = np.eye(3)
        null[15 * k : 15 * k + 3, 3] = np.cross([0, 0, 1], states.T_M_I[k, 4:])
        null[15 * k + 3 : 15 * k + 6, 3] = R_M_I[k].T @ [0, 0, 1]
    null[-6:-3, :3], null[-3:, 3] = -R_G_M, [0, 0, -1]
    full = np.tril(system.matrix) + np.tril(system.matrix, -1).T
    scale = np.linalg.norm(full)
    assert np.abs(full @ null).max() < 1e-9 * scale


def test_a_landmark_behind_a_camera_is_an_outlier() -> None:
    terms, states = window()
    behind = terms.observations.p_G.copy()
    behind[0] = se3.transform(T_G_M, [0.0, 0.0, -20.0])
    lost = MapTerms(dataclasses.replace(terms.observations, p_G=behind), *rig(), huber_sigmas=1.345)
    at = lost.evaluate(states.T_M_I, T_G_M, behind)
    assert not at.is_visible[: 2 * FRAMES].any()
    assert at.is_visible[2 * FRAMES :].all()
    assert not at.jacobian[: 2 * FRAMES].any()
    assert np.isinf(lost.errors_px(states)[: 2 * FRAMES]).all()
    assert np.isfinite(list(lost.costs(states).values())).all()


def test_alignment_without_noise_is_exact() -> None:
    terms, states = window(noise_px=0.0)
    off = dataclasses.replace(
        states, T_G_M=se3.retract(states.T_G_M, [[0.3, -0.2, 0.1, 0.01, -0.02, 0.1]])
    )
    free = MapTerms(terms.observations, *rig(), huber_sigmas=1.345)
    result, covariance = aligned(free, off, 1e6 * WEAK, function_tolerance=0.0, num_iterations=30)
    np.testing.assert_allclose(se3.local(T_G_M, result), 0.0, atol=1e-8)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_residuals_are_those_of_the_camera_models() -> None:
    """The compiled kernel projects as `sensors.projection` does, with every model of cameras."""
    terms, states = window()
    now, seen = terms.evaluate(states.T_M_I, states.T_G_M[0], states.p_G), terms.observations
    cameras, T_I_C = rig()
    for row, camera in enumerate(cameras):
        mine = seen.camera == row
        T_G_C = se3.compose(se3.compose(T_G_M, states.T_M_I[seen.frame[mine]]), T_I_C[row])
        p_C = se3.transform(se3.inverse(T_G_C), seen.p_G[seen.landmark[mine]])
        expected = (project(camera, p_C)[0] - seen.uv_px[mine]) / seen.sigma_px[mine, None]
        np.testing.assert_allclose(now.residual[mine], expected, atol=1e-9)


def test_the_warmup_compiles_what_terms_evaluate() -> None:
    jobs = warmup.window_jobs()
    jobs["window landmarks"]()
    jobs["window"]()
    by_hand = (kernels.weigh, kernels.sum_observations, kernels.add_square)
    ahead_by_hand = [set(k.signatures) for k in by_hand]
    kernel = window_kernels().reproject_map
    ahead = set(kernel.signatures)
    terms, states = window()
    terms.add_to(DenseSystem.zeros(15 * FRAMES + 6), states, states)
    assert ahead == set(kernel.signatures)
    assert ahead_by_hand == [set(k.signatures) for k in by_hand]
    assert ahead


def test_composition_jacobian_is_that_of_differences() -> None:
    T_M_I = se3.make(so3.exp([0.4, -0.2, 1.0]), [1.0, 2.0, -0.5])
    J = localized.composition_jacobian(T_G_M, T_M_I)
    T_G_I = se3.compose(T_G_M, T_M_I)
    for k in range(12):
        d = np.zeros(12)
        d[k] = 1e-6
        ahead, behind = (
            se3.local(
                T_G_I, se3.compose(se3.retract(T_G_M, s * d[6:]), se3.retract(T_M_I, s * d[:6]))
            )
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(J[:, k], (ahead - behind) / 2e-6, atol=1e-8)
