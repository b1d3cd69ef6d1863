"""Small symmetric matrices: against LAPACK, and where LAPACK raises."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.geometry import symmetric

SIZES = st.integers(1, 9)


def _positive(seed: int, size: int, scale: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(20, size, size + 2))
    return scale * root @ root.transpose(0, 2, 1)


@given(st.integers(0, 1000), SIZES, st.sampled_from([1e-200, 1e-8, 1.0, 1e150]))
def test_eigenvalues_equal_those_of_lapack(seed: int, size: int, scale: float) -> None:
    A = _positive(seed, size, scale)
    A -= scale * size * np.eye(size)  # some eigenvalues are negative
    values, vectors = symmetric.eigen(A)
    largest = np.abs(values).max(axis=1)
    np.testing.assert_allclose(
        values / largest[:, None], np.linalg.eigvalsh(A) / largest[:, None], atol=1e-14
    )
    again = vectors @ (values[:, :, None] / scale * vectors.transpose(0, 2, 1))
    np.testing.assert_allclose(again, A / scale, atol=1e-13 * (largest / scale).max())
    np.testing.assert_allclose(
        vectors.transpose(0, 2, 1) @ vectors, np.broadcast_to(np.eye(size), A.shape), atol=1e-14
    )


def test_small_eigenvalues_of_a_scaled_matrix_keep_their_digits() -> None:
    scale = np.diag([1.0, 1e-8, 1e-14])
    A = scale @ np.array([[2.0, 1.0, 0.5], [1.0, 3.0, 1.0], [0.5, 1.0, 2.0]]) @ scale
    smallest = symmetric.eigen(A[None])[0][0, 0]
    exact = np.linalg.det(A / np.outer(np.diag(scale), np.diag(scale))) * np.linalg.det(scale) ** 2
    exact /= np.linalg.det(A[:2, :2])
    assert smallest == pytest.approx(exact, rel=1e-6)


@given(st.integers(0, 1000), SIZES)
def test_inverses_and_factors_invert(seed: int, size: int) -> None:
    A = _positive(seed, size) + np.eye(size)
    unit = np.broadcast_to(np.eye(size), A.shape)
    np.testing.assert_allclose(symmetric.inverse(A) @ A, unit, atol=1e-10)
    for W in (symmetric.lower_whitening(A), symmetric.whitening(A, 1e-12)):
        np.testing.assert_allclose(W @ A @ W.transpose(0, 2, 1), unit, atol=1e-10)
    lower = symmetric.lower_whitening(A)
    np.testing.assert_allclose(lower, np.linalg.inv(np.linalg.cholesky(A)), atol=1e-10)
    assert not np.triu(lower, 1).any()


def test_a_direction_without_information_is_as_uncertain_as_the_least_says() -> None:
    ray = np.array([0.6, 0.0, 0.8])
    for weight in (1e-3, 1.0, 1e12, 1e25, 1e150):
        A = weight * (np.eye(3) - np.outer(ray, ray)) + 1e-4 * np.eye(3)
        assert ray @ symmetric.inverse(A[None], 1e-4)[0] @ ray == pytest.approx(1e4, rel=1e-3)


def test_zero_information_is_infinite_variance() -> None:
    np.testing.assert_array_equal(
        symmetric.inverse(np.zeros((1, 2, 2))), [[[np.inf, 0.0], [0.0, np.inf]]]
    )


@pytest.mark.parametrize("entry", [np.nan, np.inf, -np.inf])
def test_entries_that_are_no_numbers_raise_nothing(entry: float) -> None:
    A = np.stack([np.eye(3), np.eye(3)])
    A[0, 1, 0] = entry
    values, vectors = symmetric.eigen(A)
    assert np.isnan(values[0]).all()
    np.testing.assert_array_equal(vectors[0], np.eye(3))
    assert np.isnan(symmetric.inverse(A)[0]).all()
    np.testing.assert_array_equal(symmetric.inverse(A)[1], np.eye(3))
    np.testing.assert_array_equal(symmetric.is_positive_definite(A), [False, True])


def test_singular_covariances_have_a_factor() -> None:
    W = symmetric.lower_whitening(np.ones((1, 3, 3)))
    assert np.isfinite(W).all()
    assert not symmetric.is_positive_definite(np.ones((1, 3, 3)))[0]


def test_no_matrices_give_none() -> None:
    empty = np.zeros((0, 3, 3))
    assert symmetric.inverse(empty).shape == (0, 3, 3)
    assert symmetric.eigen(empty)[0].shape == (0, 3)
