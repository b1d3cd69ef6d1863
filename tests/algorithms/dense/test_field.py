"""Distance fields and distances from triangles against closed form, scipy's transform and brute force."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.algorithms.dense.field import (
    DistanceField,
    decode_field,
    distance_field,
    encode_field,
    voxel_centres,
)
from maplab_py.algorithms.dense.grid import GridSettings, TsdfGrid, blocks_of_views
from maplab_py.algorithms.dense.options import DistanceOptions
from maplab_py.algorithms.dense.pinhole import Pinhole
from maplab_py.algorithms.dense.triangle_tree import TriangleTree
from maplab_py.array_types import F64, I32
from maplab_py.errors import EstimationError, MapError
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


def test_nothing_and_too_much_are_refused() -> None:
    with pytest.raises(EstimationError, match="without triangles"):
        TriangleTree(np.zeros((3, 3)), np.zeros((0, 3), dtype=np.int32))
    p, faces = triangles(5000, 1)
    with memory_limited(0.001, "--dense_max_memory_gb"), pytest.raises(NotEnoughMemory):
        TriangleTree(p, faces)
    assert TriangleTree(p, faces).distances(np.zeros((0, 3))).shape == (0,)


VOXEL_M, LIMIT_M = 0.1, 1.0
SETTINGS = GridSettings(VOXEL_M, 0.3, 0.1, 6.0, 0, 1e4)
OPTIONS = DistanceOptions(max_distance_m=LIMIT_M)
BLOCK_M = 8 * VOXEL_M


def grid_of(distance_m: F64, blocks: np.ndarray, weight: float = 1.0) -> TsdfGrid:
    """Return a grid of blocks whose voxels have signed distances (B, 8, 8, 8)."""
    limited = np.clip(distance_m / SETTINGS.truncation_m, -1.0, 1.0).astype(np.float32)
    observed = np.where(distance_m > -SETTINGS.truncation_m, np.float32(weight), np.float32(0.0))
    return TsdfGrid(SETTINGS, blocks.astype(np.int32), limited, observed)


def cube_of_blocks(low: int, high: int) -> np.ndarray:
    side = np.arange(low, high)
    return np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)


def plane() -> tuple[TsdfGrid, F64, F64]:
    blocks = cube_of_blocks(-1, 1)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    truth = voxel_centres(blocks.astype(np.int32), VOXEL_M) @ normal
    return grid_of(truth, blocks), blocks, truth


def field_of(grid: TsdfGrid, options: DistanceOptions = OPTIONS) -> DistanceField:
    return distance_field(grid, np.zeros((1, 3)), options, 0.5)


def test_distances_from_a_plane() -> None:
    grid, _, _ = plane()
    field = field_of(grid)
    normal = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
    p = field.centres()
    truth = p @ normal
    known = np.isfinite(field.distance_m)
    np.testing.assert_array_equal(known, truth > -SETTINGS.truncation_m)
    # the foot of the perpendicular must lie on the part of the plane that was observed
    inner = known & (np.abs(p - truth[..., None] * normal).max(axis=-1) < BLOCK_M - 2 * VOXEL_M)
    assert np.count_nonzero(inner) > 1000
    off = np.abs(field.distance_m - np.minimum(truth, LIMIT_M))
    assert off[inner].max() < 0.02 * VOXEL_M
    assert (field.distance_m[known] - np.minimum(truth, LIMIT_M)[known] > -0.02 * VOXEL_M)[
        truth[known] > 0
    ].all()


def test_distances_from_a_sphere() -> None:
    blocks, radius = cube_of_blocks(-2, 2), 0.75
    truth = np.linalg.norm(voxel_centres(blocks.astype(np.int32), VOXEL_M), axis=-1) - radius
    field = field_of(grid_of(truth, blocks))
    expected = np.linalg.norm(field.centres(), axis=-1) - radius
    known = np.isfinite(field.distance_m)
    np.testing.assert_array_equal(known, expected > -SETTINGS.truncation_m)
    error = np.abs(field.distance_m - np.minimum(expected, LIMIT_M))[known]
    # a triangle of circumradius c lies inside by up to c^2 / (2 radius), and c is below sqrt(2) voxels
    assert error.max() < VOXEL_M**2 / radius
    assert error.mean() < 0.03 * VOXEL_M


def test_the_field_is_that_of_the_mesh() -> None:
    grid, _, _ = plane()
    mesh, field = grid.mesh(0.5), field_of(grid)
    known = np.isfinite(field.distance_m)
    expected = to_every_triangle(field.centres()[known], mesh.p, mesh.faces)
    np.testing.assert_allclose(
        np.abs(field.distance_m[known]), np.minimum(expected, LIMIT_M), atol=1e-6
    )


def test_the_unseen_is_unknown_and_the_unconfirmed_is_not_behind() -> None:
    grid, _, truth = plane()
    weight = np.array(grid.weight)
    weight[truth > 0.5] = 0.0
    weight[truth < -0.2] = 0.1  # less than the mesh needs
    thinned = TsdfGrid(SETTINGS, grid.coordinates, grid.distance, weight)
    field = field_of(thinned)
    known = np.isfinite(field.distance_m)
    expected = (truth <= 0.5) & (truth >= -0.2)
    np.testing.assert_array_equal(known, expected)


def test_spheres_around_cameras() -> None:
    grid, _, _ = plane()
    camera = np.array([[0.1, 0.05, 0.95]])
    spheres = DistanceOptions(
        max_distance_m=2.0,
        use_clear_sphere=True,
        clear_sphere_inner_radius=0.35,
        clear_sphere_outer_radius=0.7,
    )
    plain = distance_field(grid, camera, dataclasses.replace(OPTIONS, max_distance_m=2.0), 0.5)
    field = distance_field(grid, camera, spheres, 0.5)
    before, after = plain.at(field.centres().reshape(-1, 3)), field.distance_m.reshape(-1)
    known = np.isfinite(before)
    np.testing.assert_array_equal(after[known], before[known].astype(np.float32))
    distance = np.linalg.norm(field.centres().reshape(-1, 3) - camera, axis=1)
    new = ~known & np.isfinite(after)
    np.testing.assert_array_equal(new, ~known & (distance <= 0.7))
    inner = new & (distance <= 0.35)
    assert inner.any()
    assert (after[inner] > 0.0).all()
    assert (after[new & (distance > 0.35)] == -2.0).all()
    # every voxel of the sphere is there, known before or not
    inside = camera + np.random.default_rng(0).uniform(-0.4, 0.4, (500, 3))
    assert np.isfinite(field.at(inside)[np.linalg.norm(inside - camera, axis=1) < 0.6]).all()


def test_points_are_looked_up_in_their_voxels() -> None:
    field = field_of(plane()[0])
    known = np.isfinite(field.distance_m)
    centres = field.centres()[known]
    shifts = np.random.default_rng(1).uniform(-0.49, 0.49, centres.shape) * VOXEL_M
    np.testing.assert_array_equal(field.at(centres + shifts), field.distance_m[known])
    assert np.isnan(field.at(np.array([[100.0, 0.0, 0.0], [-0.79, 5e3, -3.0]]))).all()


def test_rays_leave_free_space_behind() -> None:
    pinhole = Pinhole(100.0, (79.5, 59.5), 160, 120)
    depth = np.full((120, 160), 2.0, dtype=np.float32)
    view = depth, pinhole, np.eye(4)
    band, blocks = (
        blocks_of_views([view], SETTINGS, with_free_space=free) for free in (False, True)
    )
    grid = TsdfGrid.unobserved(SETTINGS, blocks)
    grid.integrate(*view)
    assert {tuple(c) for c in band} <= {tuple(c) for c in blocks}
    field = distance_field(grid, np.zeros((1, 3)), DistanceOptions(max_distance_m=5.0), 0.5)
    along = np.arange(0.2, 1.95, 0.1) + 0.05
    on_axis = np.stack([0.01 + 0.0 * along, 0.01 + 0.0 * along, along], axis=1)
    np.testing.assert_allclose(field.at(on_axis), 2.0 - along, atol=1e-5)
    beside = np.stack([1.5 + 0.0 * along[:8], 0.0 * along[:8], along[:8]], axis=1)
    assert np.isnan(field.at(beside)).all()


def test_a_file_holds_everything() -> None:
    field = field_of(plane()[0])
    data = encode_field(field)
    loaded = decode_field(data, "field")
    assert encode_field(loaded) == data
    assert (loaded.voxel_size_m, loaded.max_distance_m) == (VOXEL_M, LIMIT_M)
    np.testing.assert_array_equal(loaded.distance_m, field.distance_m)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"\x0a\x05", "no distance field of maplab-py"),
        (lambda data: data[:-1], "damaged or ends early"),
        (lambda data: data[:25], "header of the distance field is damaged"),
        (lambda data: data.replace(b'"blocks": ', b'"blocks": 9'), "ends early"),
        (lambda data: data.replace(b'"blocks"', b'"blocky"'), "header"),
        (lambda data: data.replace(b'"blocks": ', b'"blocks": -'), "header"),
    ],
)
def test_damaged_files_are_refused(damage: object, message: str) -> None:
    data = damage(encode_field(field_of(plane()[0])))  # type: ignore[operator]
    with pytest.raises(MapError, match=message) as error:
        decode_field(data, "distance field 7")
    assert str(error.value).startswith("distance field 7: ")
    assert "create_esdf_from_depth_resource" in str(error.value)


def test_a_grid_without_a_surface_and_too_little_memory() -> None:
    grid, _, _ = plane()
    with pytest.raises(EstimationError, match="--dense_tsdf_mesh_min_weight"):
        distance_field(grid, np.zeros((1, 3)), OPTIONS, 1e3)
    far = dataclasses.replace(OPTIONS, use_clear_sphere=True, clear_sphere_outer_radius=200.0)
    with (
        memory_limited(0.05, "--dense_max_memory_gb"),
        pytest.raises(NotEnoughMemory, match="--dense_max_memory_gb"),
    ):
        field_of(grid, far)
