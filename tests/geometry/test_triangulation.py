"""Points of rays, and functions of symmetric matrices."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.geometry import symmetric
from maplab_py.geometry.triangulation import largest_ray_angle, triangulate


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(21)


def scene(rng: np.random.Generator, counts: np.ndarray, noise: float = 0.0):
    start = np.concatenate([[0], np.cumsum(counts)])
    points = rng.normal(size=(len(counts), 3)) * 3 + [0, 0, 8]
    origins = rng.normal(size=(start[-1], 3))
    rays = (np.repeat(points, counts, axis=0) - origins) * rng.uniform(0.1, 5, (start[-1], 1))
    return points, origins, rays + rng.normal(size=rays.shape) * noise, start


def test_exact_rays_meet_in_their_points(rng: np.random.Generator) -> None:
    counts = rng.integers(0, 12, 300)
    points, origins, rays, start = scene(rng, counts)
    found, ok, _ = triangulate(origins, rays, start)
    assert np.array_equal(ok, counts >= 2)
    assert np.max(np.abs(found - points)[ok]) < 1e-8
    assert np.all(found[~ok] == 0.0)


def test_noisy_points_are_nearest_to_their_rays(rng: np.random.Generator) -> None:
    counts = np.array([2, 3, 7, 20])
    _, origins, rays, start = scene(rng, counts, noise=0.05)
    found, ok, _ = triangulate(origins, rays, start)
    assert ok.all()
    for row, (begin, end) in enumerate(itertools.pairwise(start)):
        d = rays[begin:end] / np.linalg.norm(rays[begin:end], axis=1, keepdims=True)
        # [I -d_i] [p; depth_i] = o_i, depths and all
        n = end - begin
        A = np.zeros((3 * n, 3 + n))
        A[:, :3] = np.tile(np.eye(3), (n, 1))
        for i in range(n):
            A[3 * i : 3 * i + 3, 3 + i] = -d[i]
        expected = np.linalg.lstsq(A, origins[begin:end].reshape(-1), rcond=None)[0][:3]
        assert found[row] == pytest.approx(expected, abs=1e-9)


def test_far_from_the_origin_nothing_cancels(rng: np.random.Generator) -> None:
    points, origins, rays, start = scene(rng, np.full(50, 5))
    shift = np.array([4.6e5, 5.2e6, 400.0])
    found, ok, _ = triangulate(origins + shift, rays, start)
    assert ok.all()
    assert np.max(np.abs(found - shift - points)) < 1e-6


def test_parallel_and_lonely_rays_are_not_ok(rng: np.random.Generator) -> None:
    directions = np.array(
        [[0, 0, 1.0], [0, 0, 2.0], [1.0, 0, 0], [0, 0, 1], [1e-8, 0, 1], [0, 1, 0]]
    )
    origins = rng.normal(size=(6, 3))
    points, ok, angle = triangulate(origins, directions, [0, 2, 3, 3, 5, 6])
    assert ok.tolist() == [False] * 5
    assert np.all(np.isfinite(points))
    assert angle == pytest.approx([0, 0, 0, 1e-8, 0], abs=1e-12)


def test_largest_angle_is_exact(rng: np.random.Generator) -> None:
    counts = np.concatenate([rng.integers(0, 9, 100), [60, 200]])
    start = np.concatenate([[0], np.cumsum(counts)])
    rays = rng.normal(size=(start[-1], 3)) + np.array([0, 0, 2])
    angles = largest_ray_angle(rays, start)
    for row, (begin, end) in enumerate(itertools.pairwise(start)):
        d = rays[begin:end] / np.linalg.norm(rays[begin:end], axis=1, keepdims=True)
        cosine = np.clip(d @ d.T, -1, 1)
        expected = np.arccos(cosine.min()) if end - begin > 1 else 0.0
        assert angles[row] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize("angle", [1e-9, 1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-9])
def test_tiny_and_flat_angles_are_accurate(angle: float) -> None:
    rays = np.array([[1.0, 0, 0], [np.cos(angle), np.sin(angle), 0]])
    assert largest_ray_angle(rays, [0, 2])[0] == pytest.approx(angle, rel=1e-7, abs=1e-15)


def test_large_groups_are_cut_without_a_change(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = np.arange(0, 2001, 20)
    rays = rng.normal(size=(2000, 3))
    whole = largest_ray_angle(rays, start)
    monkeypatch.setattr("maplab_py.geometry.triangulation._PAIRS_AT_ONCE", 1000)
    assert np.array_equal(largest_ray_angle(rays, start), whole)


def test_nothing_to_do() -> None:
    points, ok, angle = triangulate(np.zeros((0, 3)), np.zeros((0, 3)), [0])
    assert (points.shape, ok.shape, angle.shape) == ((0, 3), (0,), (0,))
    points, ok, _ = triangulate(np.zeros((0, 3)), np.zeros((0, 3)), [0, 0, 0])
    assert (points.shape, ok.tolist()) == ((2, 3), [False, False])


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
