"""The spline's derivatives against finite differences, and its smoothness."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.simulation.motion import motion_spline
from maplab_py.simulation.scenario import MOTION_KINDS, SessionOptions, WorldOptions
from maplab_py.simulation.spline import PoseSpline

STEP_S = 1e-3
_WEIGHTS = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}


def _random_spline(seed: int) -> PoseSpline:
    rng = np.random.default_rng(seed)
    phi = np.cumsum(rng.normal(0.0, 0.3, (20, 3)), axis=0)
    return PoseSpline(se3.make(so3.exp(phi), rng.normal(0.0, 1.0, (20, 3))), 0.2)


def _room_spline(kind: str) -> PoseSpline:
    layout = "corridor" if kind == "corridor" else "rooms"
    world = WorldOptions(layout=layout, floors=2, room_size_m=(20.0, 16.0, 3.5))
    return motion_spline(SessionOptions(kind=kind), world, np.random.default_rng(3))


SPLINES = [_random_spline(0), _random_spline(1), *(_room_spline(kind) for kind in MOTION_KINDS)]


@pytest.mark.parametrize("spline", SPLINES)
def test_derivatives_agree_with_finite_differences(spline: PoseSpline) -> None:
    # away from the knots, where the third derivative jumps
    time = (np.arange(5, 15) + 0.37) * spline.spacing_s
    now = spline.evaluate(time)
    v, a, w, alpha = np.zeros((4, len(time), 3))
    # central differences of fourth order
    for steps, weight in _WEIGHTS.items():
        then = spline.evaluate(time + steps * STEP_S)
        factor = weight / (12.0 * STEP_S)
        v += factor * then.T_G_I[:, 4:]
        a += factor * then.v_G
        w += factor * so3.log(so3.multiply(so3.inverse(now.T_G_I[:, :4]), then.T_G_I[:, :4]))
        alpha += factor * then.w_I
    np.testing.assert_allclose(now.v_G, v, atol=1e-6)
    np.testing.assert_allclose(now.a_G, a, atol=1e-6)
    np.testing.assert_allclose(now.w_I, w, atol=1e-6)
    np.testing.assert_allclose(now.alpha_I, alpha, atol=1e-6)


@pytest.mark.parametrize("spline", SPLINES)
def test_motion_is_continuous_at_knots(spline: PoseSpline) -> None:
    knots = np.arange(1, 10) * spline.spacing_s
    left, right = spline.evaluate(knots - 1e-12), spline.evaluate(knots)
    for name in ("T_G_I", "v_G", "a_G", "w_I", "alpha_I"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), atol=1e-8)


def test_constant_control_poses_stand_still() -> None:
    pose = se3.make(so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    state = PoseSpline(np.tile(pose, (6, 1)), 0.5).evaluate([0.0, 0.7, 1.5])
    np.testing.assert_allclose(state.T_G_I, np.tile(pose, (3, 1)), atol=1e-15)
    assert not state.v_G.any()
    assert not state.a_G.any()
    np.testing.assert_allclose(state.w_I, 0.0, atol=1e-15)


@pytest.mark.parametrize("time", [-0.1, 3.5])
def test_times_outside_are_refused(time: float) -> None:
    with pytest.raises(UserError, match=r"lasts from 0 to 3.4 s"):
        _random_spline(0).evaluate([time])


def test_too_few_control_poses_are_refused() -> None:
    with pytest.raises(UserError, match="four control poses"):
        PoseSpline(se3.identity(3), 0.1)
