"""Rotations: group axioms, exp and log everywhere, Jacobians against numeric differences."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplab_py.geometry import so3

numbers = st.floats(-1.0, 1.0, allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
angles = st.one_of(
    st.floats(0.0, np.pi - 1e-9),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 0.99e-4, 1e-4, 1.01e-4, 2e-4, 1e-3]),
    st.floats(np.pi - 1e-3, np.pi - 1e-9),
)
SHAPES = [(), (1,), (5,), (2, 3), (0,), (2, 1, 4)]


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    axis = draw(vectors)
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    return np.asarray(axis * draw(angles))


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(so3.log(so3.multiply(so3.inverse(a), b))), initial=0.0))


@given(rotation_vectors(), rotation_vectors(), rotation_vectors())
def test_group_axioms(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    a, b, c = so3.exp(x), so3.exp(y), so3.exp(z)
    left = so3.multiply(so3.multiply(a, b), c)
    assert distance(left, so3.multiply(a, so3.multiply(b, c))) < 1e-14
    assert distance(so3.multiply(a, so3.inverse(a)), so3.identity()) < 1e-15
    assert np.array_equal(so3.multiply(a, so3.identity()), a)
    assert np.linalg.norm(left) == pytest.approx(1.0, abs=1e-15)


@given(rotation_vectors())
def test_log_inverts_exp(phi: np.ndarray) -> None:
    q = so3.exp(phi)
    assert np.max(np.abs(so3.log(q) - phi)) < 1e-8 * (np.linalg.norm(phi) > 3.1) + 1e-15
    assert np.allclose(so3.log(-q), so3.log(q), atol=1e-15, rtol=0)


@given(rotation_vectors())
def test_matrices_agree_with_opencv_and_come_back(phi: np.ndarray) -> None:
    R = so3.to_matrix(so3.exp(phi))
    assert np.allclose(R, cv2.Rodrigues(phi)[0], atol=1e-14)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
    back = so3.from_matrix(R)
    assert back[3] >= 0.0
    assert distance(back, so3.exp(phi)) < 1e-14


@given(rotation_vectors(), vectors, vectors)
def test_rotation_of_vectors(phi: np.ndarray, u: np.ndarray, v: np.ndarray) -> None:
    q = so3.exp(phi)
    assert np.allclose(so3.rotate(q, v), so3.to_matrix(q) @ v, atol=1e-14)
    cross = np.cross(so3.rotate(q, u), so3.rotate(q, v))
    assert np.allclose(so3.rotate(q, np.cross(u, v)), cross, atol=1e-14)
    assert np.allclose(so3.skew(u) @ v, np.cross(u, v), atol=1e-15)


@pytest.mark.parametrize("axis", np.concatenate([np.eye(3), -np.eye(3), np.ones((1, 3)) / 3**0.5]))
def test_half_turns(axis: np.ndarray) -> None:
    q = so3.exp(np.pi * axis)
    assert np.linalg.norm(so3.log(q)) == pytest.approx(np.pi, abs=1e-15)
    assert np.allclose(np.abs(so3.log(q)), np.pi * np.abs(axis), atol=1e-14)
    back = so3.from_matrix(so3.to_matrix(q))
    assert np.allclose(np.abs(back), np.abs(q), atol=1e-15)


@settings(max_examples=60)
@given(rotation_vectors())
def test_right_jacobian_is_the_derivative_of_exp(phi: np.ndarray) -> None:
    step = 1e-6
    columns = []
    for d in np.eye(3) * step:
        forward = so3.log(so3.multiply(so3.inverse(so3.exp(phi)), so3.exp(phi + d)))
        backward = so3.log(so3.multiply(so3.inverse(so3.exp(phi)), so3.exp(phi - d)))
        columns.append((forward - backward) / (2 * step))
    assert np.allclose(so3.right_jacobian(phi), np.stack(columns, axis=1), atol=1e-9)


@given(rotation_vectors())
def test_jacobian_inverse(phi: np.ndarray) -> None:
    product = so3.right_jacobian(phi) @ so3.right_jacobian_inverse(phi)
    assert np.allclose(product, np.eye(3), atol=1e-13)


def test_jacobians_are_smooth_where_the_series_takes_over() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    below, above = axis * 0.999999999e-4, axis * 1.000000001e-4
    for function in (so3.right_jacobian, so3.right_jacobian_inverse):
        assert np.max(np.abs(function(below) - function(above))) < 1e-12
    assert np.max(np.abs(so3.exp(below) - so3.exp(above))) < 1e-12


@pytest.mark.parametrize("shape", SHAPES)
def test_batch_shapes(shape: tuple[int, ...]) -> None:
    phi = np.random.default_rng(0).normal(size=(*shape, 3))
    q = so3.exp(phi)
    assert q.shape == (*shape, 4)
    assert so3.identity(*shape).shape == (*shape, 4)
    assert so3.log(q).shape == phi.shape
    assert so3.multiply(q, so3.identity()).shape == q.shape
    assert so3.rotate(q, np.ones(3)).shape == phi.shape
    for function in (so3.skew, so3.right_jacobian, so3.right_jacobian_inverse):
        assert function(phi).shape == (*shape, 3, 3)
    assert so3.from_matrix(so3.to_matrix(q)).shape == q.shape
