"""Distances from triangles against every triangle, against closed form, and for degenerate ones."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.algorithms.dense.triangle_tree import TriangleTree
from maplab_py.array_types import F64, I32
from maplab_py.errors import EstimationError
from maplab_py.memory import NotEnoughMemory, memory_limited


def triangles(count: int, seed: int) -> tuple[F64, I32]:
    """Return vertices and corners of triangles at random, some of them degenerate."""
    rng = np.random.default_rng(seed)
    p = rng.normal(size=(max(count, 3), 3))
    return p, rng.integers(0, len(p), (count, 3)).astype(np.int32)


def to_every_triangle(points: F64, p: F64, faces: I32) -> F64:
    """Return distances (N,) by minimising over each triangle's inside, its edges and its corners."""
    best = np.full(len(points), np.inf)
    for a, b, c in p[faces]:
        for start, end in ((a, b), (b, c), (c, a)):
            side = end - start
            s = np.clip((points - start) @ side / max(side @ side, 1e-300), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(points - start - s[:, None] * side, axis=1))
        normal = np.cross(b - a, c - a)
        if np.linalg.norm(normal) < 1e-12:
            continue
        normal /= np.linalg.norm(normal)
        height = (points - a) @ normal
        foot = points - height[:, None] * normal
        sides = [np.cross(v - u, foot - u) @ normal for u, v in ((a, b), (b, c), (c, a))]
        inside = np.all(np.array(sides) >= 0.0, axis=0)
        best = np.where(inside, np.minimum(best, np.abs(height)), best)
    return best


@given(count=st.integers(1, 60), seed=st.integers(0, 1000))
def test_the_distance_is_that_of_the_nearest_triangle(count: int, seed: int) -> None:
    p, faces = triangles(count, seed)
    points = np.random.default_rng(seed + 1).normal(size=(40, 3)) * 2.0
    distance = TriangleTree(p, faces).distances(points)
    np.testing.assert_allclose(distance, to_every_triangle(points, p, faces), atol=1e-9)


def test_many_triangles_and_neighbouring_points() -> None:
    """The bound that a point takes over from the one before hides no triangle."""
    p, faces = triangles(700, 3)
    steps = np.linspace(-2.0, 2.0, 12)
    points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    tree, expected = TriangleTree(p, faces), to_every_triangle(points, p, faces)
    np.testing.assert_allclose(tree.distances(points), expected, atol=1e-9)
    limited = tree.distances(points, 0.4)
    np.testing.assert_allclose(limited, np.minimum(expected, 0.4), atol=1e-9)
    order = np.random.default_rng(1).permutation(len(points))
    np.testing.assert_allclose(tree.distances(points[order]), expected[order], atol=1e-9)


def test_points_of_the_surface_have_none() -> None:
    p, faces = triangles(90, 8)
    weights = np.random.default_rng(2).dirichlet([1.0, 1.0, 1.0], len(faces))
    points = np.einsum("fk,fki->fi", weights, p[faces])
    np.testing.assert_allclose(TriangleTree(p, faces).distances(points), 0.0, atol=1e-7)


def test_threads_give_the_same_bytes() -> None:
    before = numba.get_num_threads()
    p, faces = triangles(300, 5)
    points = np.random.default_rng(5).normal(size=(3000, 3))
    results = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        results.append(TriangleTree(p, faces).distances(points).tobytes())
    numba.set_num_threads(before)
    assert results[0] == results[1]


def test_nothing_and_too_much_are_refused() -> None:
    with pytest.raises(EstimationError, match="without triangles"):
        TriangleTree(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int32))
    p, faces = triangles(5000, 1)
    with memory_limited(0.001, "--dense_max_memory_gb"), pytest.raises(NotEnoughMemory):
        TriangleTree(p, faces)
    assert TriangleTree(p, faces).distances(np.zeros((0, 3))).shape == (0,)
