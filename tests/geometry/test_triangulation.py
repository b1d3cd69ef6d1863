"""Triangulation and ray angles against loops over landmarks."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

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
