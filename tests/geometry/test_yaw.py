"""The yaw-and-position group."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.geometry import se3, so3, yaw

elements = st.tuples(
    *(st.floats(-5.0, 5.0) for _ in range(3)), st.floats(-np.pi + 1e-9, np.pi - 1e-9)
).map(np.array)
SMALL = [0.0, 1e-300, 1e-12, 0.99e-4, 1.01e-4, 1e-3, np.pi - 1e-9]


def near(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-12) -> bool:
    return bool(np.max(np.abs(yaw.local(a, b)), initial=0.0) < tolerance)


@given(elements, elements, elements)
def test_group_axioms(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    left = yaw.compose(yaw.compose(a, b), c)
    assert near(left, yaw.compose(a, yaw.compose(b, c)))
    assert near(yaw.compose(a, yaw.inverse(a)), yaw.identity())
    assert near(yaw.compose(yaw.inverse(a), a), yaw.identity())
    assert near(yaw.compose(a, yaw.identity()), a)


@given(elements, elements)
def test_poses_are_a_subgroup(a: np.ndarray, b: np.ndarray) -> None:
    composed = se3.compose(yaw.to_pose(a), yaw.to_pose(b))
    assert near(yaw.from_pose(composed), yaw.compose(a, b))
    p = b[:3]
    assert np.allclose(yaw.transform(a, p), se3.transform(yaw.to_pose(a), p), atol=1e-13)


@given(elements)
def test_log_inverts_exp(tangent: np.ndarray) -> None:
    assert np.allclose(yaw.log(yaw.exp(tangent)), tangent, atol=1e-12)


@pytest.mark.parametrize("angle", SMALL + [-a for a in SMALL])
def test_exp_near_zero_and_pi(angle: float) -> None:
    tangent = np.array([1.0, -2.0, 0.5, angle])
    steps = 1024
    element = yaw.identity()
    part = yaw.exp(tangent / steps)
    for _ in range(steps):
        element = yaw.compose(element, part)
    assert near(yaw.exp(tangent), element, 1e-11)
    assert np.allclose(yaw.log(yaw.exp(tangent)), tangent, atol=1e-13)


@given(elements, elements)
def test_local_inverts_retract(a: np.ndarray, delta: np.ndarray) -> None:
    assert np.allclose(yaw.local(a, yaw.retract(a, delta)), delta, atol=1e-12)


def test_yaw_is_that_of_the_nearest_rotation_about_z() -> None:
    rng = np.random.default_rng(3)
    q = so3.exp(rng.normal(size=(20, 3)))
    candidates = np.linspace(-np.pi, np.pi, 20001)
    R = so3.to_matrix(yaw.quaternion(candidates))
    for one in q:
        distance = np.sum((R - so3.to_matrix(one)) ** 2, axis=(1, 2))
        assert abs(yaw.wrap(candidates[np.argmin(distance)] - yaw.yaw_of(one))) < 4e-4
    assert np.allclose(yaw.yaw_of(-q), yaw.yaw_of(q))


def test_angles_wrap() -> None:
    assert yaw.wrap(3 * np.pi / 2) == pytest.approx(-np.pi / 2)
    near_pi = np.array([0.0, 0.0, 0.0, 3.0])
    assert yaw.compose(near_pi, near_pi)[3] == pytest.approx(6.0 - 2 * np.pi)
    assert yaw.local([0, 0, 0, 3.1], [0, 0, 0, -3.1])[3] == pytest.approx(2 * np.pi - 6.2)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 3), (0,)])
def test_batch_shapes(shape: tuple[int, ...]) -> None:
    a = np.random.default_rng(1).normal(size=(*shape, 4))
    for result in (yaw.exp(a), yaw.log(a), yaw.inverse(a), yaw.compose(a, np.zeros(4))):
        assert result.shape == a.shape
    assert yaw.to_pose(a).shape == (*shape, 7)
    assert yaw.from_pose(yaw.to_pose(a)).shape == a.shape
    assert yaw.transform(a, np.ones(3)).shape == (*shape, 3)
    assert yaw.identity(*shape).shape == a.shape
