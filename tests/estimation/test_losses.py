"""Losses against finite differences, and compiled dense blocks against numpy."""

from collections.abc import Callable

import numpy as np
import pytest

from maplab_py.estimation.blocks import Manifold, ParameterBlock, ParameterBlocks
from maplab_py.estimation.codegen.kernels import visual_kernels
from maplab_py.estimation.kernels.loss import loss_and_weight
from maplab_py.estimation.linear.supernodal_solver import SupernodalCholesky
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.cameras import Cameras
from maplab_py.estimation.terms.visual import NodeSystem, Observations, VisualTerms
from maplab_py.geometry import se3, so3

SCALE = 1.7
RESIDUALS = np.array([0.0, 1e-3, 0.3, 1.0, 1.69999, 1.70001, 2.5, 10.0, 300.0])


def huber(r: float) -> float:
    return r * r if r <= SCALE else 2.0 * SCALE * r - SCALE**2


def cauchy(r: float) -> float:
    return SCALE**2 * float(np.log1p((r / SCALE) ** 2))


def tukey(r: float) -> float:
    if r >= SCALE:
        return SCALE**2 / 3.0
    return -(SCALE**2) / 3.0 * float(np.expm1(3.0 * np.log1p(-((r / SCALE) ** 2))))


def geman_mcclure(r: float) -> float:
    return r * r / (1.0 + (r / SCALE) ** 2)


def dcs(r: float) -> float:
    """Integral of the weight s^2, s = min(1, 2 phi / (phi + r^2)), by r^2.

    Source: MacTavish and Barfoot, At all costs, CRV 2015, table I.
    """
    phi = SCALE**2
    return r * r if r * r <= phi else 4.0 * phi * r * r / (phi + r * r) - phi


RHO: dict[Loss, Callable[[float], float]] = {
    Loss.NONE: lambda r: r * r,
    Loss.HUBER: huber,
    Loss.CAUCHY: cauchy,
    Loss.TUKEY: tukey,
    Loss.GEMAN_MCCLURE: geman_mcclure,
    Loss.DCS: dcs,
}


def slope(loss: Loss, s: float) -> float:
    """Differentiate rho by s = r^2, one-sided so that no kink lies between."""
    step = 1e-6 * max(s, 1e-3)
    value = [RHO[loss](float(np.sqrt(s + k * step))) for k in range(3)]
    return (-3.0 * value[0] + 4.0 * value[1] - value[2]) / (2.0 * step)


@pytest.mark.parametrize("loss", Loss)
def test_cost_and_weight_of_factors(loss: Loss) -> None:
    rho, weight = loss_and_weight(loss, SCALE**2, RESIDUALS**2)
    np.testing.assert_allclose(rho, [RHO[loss](r) for r in RESIDUALS], rtol=1e-12, atol=1e-24)
    wanted = [slope(loss, r * r) for r in RESIDUALS]
    np.testing.assert_allclose(weight, wanted, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("loss", Loss)
def test_compiled_kernels_agree(loss: Loss) -> None:
    visual = one_landmark_each(loss)
    states = in_front_of_each()
    system = linearized(visual, states)
    rho, weight = loss_and_weight(loss, SCALE**2, RESIDUALS**2)
    assert system.cost == pytest.approx(0.5 * rho.sum(), rel=1e-12)
    # the residual is r along u; d u / d x_C = fu / z = 50, so the gradient is -50 w r
    np.testing.assert_allclose(system.gradient[::5, 0], -50.0 * weight * RESIDUALS, rtol=1e-9)
    np.testing.assert_allclose(system.diagonal[::5, 0], 2500.0 * weight, rtol=1e-9)
    still = np.zeros((states.num_nodes, 3))
    new_cost = visual.take_step(states, still, states, 1.0)[1]
    assert new_cost == pytest.approx(system.cost, rel=1e-12)


def test_every_observation_has_its_own_scale() -> None:
    visual = one_landmark_each(Loss.HUBER)
    scales = np.linspace(0.5, 5.0, len(RESIDUALS))
    data = visual.observations
    visual.use(
        Observations(data.start, data.vertex, data.camera, data.uv_px, data.inverse_sigma, scales)
    )
    wanted = [
        loss_and_weight(Loss.HUBER, c * c, np.array([r * r]))[0][0]
        for c, r in zip(scales, RESIDUALS, strict=True)
    ]
    assert linearized(visual, in_front_of_each()).cost == pytest.approx(
        0.5 * sum(wanted), rel=1e-12
    )


def in_front_of_each() -> States:
    """Return vertices at the origin, each with its landmark 2 m ahead."""
    zero = np.zeros((len(RESIDUALS), 3))
    return States(se3.identity(len(zero)), zero, zero, zero, zero + np.array([0.0, 0.0, 2.0]))


def linearized(visual: VisualTerms, states: States) -> NodeSystem:
    solver = SupernodalCholesky(*visual.block_nodes(states), states.num_nodes, 3)
    solver.clear()
    return visual.linearize(states, 0.0, solver, visual.places(states, solver))


def one_landmark_each(loss: Loss) -> VisualTerms:
    """Return one observation per vertex and landmark, off by RESIDUALS sigmas; landmarks fixed."""
    count = len(RESIDUALS)
    sigma = 0.5
    observations = Observations(
        start=np.arange(count + 1, dtype=np.int64),
        vertex=np.arange(count, dtype=np.int32),
        camera=np.zeros(count, dtype=np.int32),
        uv_px=np.stack([50.0 - sigma * RESIDUALS, np.full(count, 50.0)], axis=1),
        inverse_sigma=np.full(count, 1.0 / sigma),
        loss_scale=np.full(count, SCALE),
    )
    cameras = Cameras(se3.identity(1), np.array([[0.0, 50.0, 50.0, 50.0, 50.0]]))
    kernels = visual_kernels()
    return VisualTerms(kernels, observations, cameras, count, loss=loss, move_points=False)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def blocks(rng: np.random.Generator) -> ParameterBlocks:
    return ParameterBlocks(
        [
            ParameterBlock("five", rng.normal(size=(2, 5))),
            ParameterBlock("pose", se3.exp(rng.normal(size=(3, 6))), Manifold.POSE),
            ParameterBlock("rotation", so3.exp(rng.normal(size=(1, 3))), Manifold.ROTATION),
            ParameterBlock("switch", np.array([[0.9], [0.1]]), lower=0.0, upper=1.0),
        ]
    )


def test_nodes_follow_one_another_behind_the_vertices(rng: np.random.Generator) -> None:
    some = blocks(rng)
    assert some.num_nodes == 2 * 2 + 3 * 2 + 1 + 2
    assert some.nodes("five", 10).tolist() == [[10, 11], [12, 13]]
    assert some.nodes("pose", 10).tolist() == [[14, 15], [16, 17], [18, 19]]
    assert some.nodes("rotation", 10).tolist() == [[20]]
    assert some.nodes("switch", 10).tolist() == [[21], [22]]


def test_padding_names_the_directions_without_a_parameter(rng: np.random.Generator) -> None:
    nodes, projectors = blocks(rng).padding(10)
    assert nodes.tolist() == [11, 13, 21, 22]
    np.testing.assert_array_equal(projectors[0], np.diag([1, 1, 0]))
    np.testing.assert_array_equal(projectors[2], np.diag([1, 0, 0]))


@pytest.mark.parametrize("name", ["five", "pose", "rotation"])
def test_difference_undoes_a_step(rng: np.random.Generator, name: str) -> None:
    some = blocks(rng)
    step = rng.normal(0, 0.3, (some.num_nodes, 3))
    moved = some.moved(step)[name]
    own = step[some.nodes(name, 0)].reshape(len(moved), -1)[:, : moved.dimension]
    np.testing.assert_allclose(moved.difference(some[name].values), own, atol=1e-12)


def test_steps_stop_at_bounds(rng: np.random.Generator) -> None:
    some = blocks(rng)
    moved = some.moved(np.full((some.num_nodes, 3), 0.5))["switch"]
    np.testing.assert_allclose(moved.values, [[1.0], [0.6]])
