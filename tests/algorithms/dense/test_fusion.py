"""Fusion of true depth against the true surfaces, and grids of planes and spheres against closed form."""

import dataclasses
from pathlib import Path

import numba
import numpy as np
import pytest

from maplab_py.algorithms.dense import fusion, meshing, pinhole
from maplab_py.algorithms.dense.clouds import convert_depth_maps
from maplab_py.algorithms.dense.depth_inputs import SceneDepth, grid_settings
from maplab_py.algorithms.dense.field import create_fields
from maplab_py.algorithms.dense.grid import GridSettings, Mesh, TsdfGrid, View, blocks_of_views
from maplab_py.algorithms.dense.options import FusionOptions
from maplab_py.array_types import F32, F64
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.interop.resources.depth_maps import import_depth_maps
from maplab_py.memory import NotEnoughMemory, memory_limited
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import ResourceOwner, VIMap, merge, resources_of, without_resources
from tests.support.stereo_room import StereoRoom

OPTIONS = FusionOptions(voxel_size_m=0.1)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> StereoRoom:
    return StereoRoom.simulated(tmp_path_factory.mktemp("stereo"))


@pytest.fixture(scope="module")
def with_depth(room: StereoRoom) -> VIMap:
    return import_depth_maps(room.true_map, 0, 0, room.depth())[0]


def moved(vi_map: VIMap, vertices: slice, motion_m: float) -> VIMap:
    """Return the map with some vertices elsewhere."""
    T_M_I: F64 = np.array(vi_map.vertices.T_M_I)
    T_M_I[vertices, 4] += motion_m
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T_M_I))


def distances(room: StereoRoom, vi_map: VIMap, min_weight: float = 0.1) -> F64:
    mesh, _ = meshing.map_mesh(vi_map, Path(), None, min_weight)
    return room.distances_to_surfaces(mesh.p)


def test_true_depth_gives_the_true_surfaces(room: StereoRoom, with_depth: VIMap) -> None:
    fused, report = fusion.fuse_depth(with_depth, Path(), None, FusionOptions(voxel_size_m=0.05))
    assert report.resource_type == "raw_depth_maps"
    assert report.grids[0].added == len(with_depth.vertices)
    off_m = distances(room, fused)
    assert len(off_m) > 5000
    assert off_m.mean() < 0.0025
    assert np.percentile(off_m, 90) < 0.004
    assert np.mean(off_m > 0.1) < 0.001


@pytest.mark.parametrize(
    ("depth_m", "voxel_m"), [(0.0, 0.01), (0.65, 0.015), (2.0, 0.05), (3.9, 0.075), (50.0, 0.1)]
)
def test_voxels_suit_the_depth_of_the_scene(depth_m: float, voxel_m: float) -> None:
    scene = SceneDepth(depth_m, 1.0)
    settings = grid_settings(FusionOptions(), scene)
    assert (settings.voxel_size_m, settings.truncation_m) == (voxel_m, 3.0 * voxel_m)
    assert grid_settings(FusionOptions(voxel_size_m=0.07), scene).voxel_size_m == 0.07


def test_the_depth_of_a_scene_is_reported(room: StereoRoom, with_depth: VIMap) -> None:
    every = FusionOptions(integrate_every_nth=10)
    (grid,) = fusion.fuse_depth(with_depth, room.map_folder, options=every)[1].grids
    assert grid.depth_in_range == 1.0
    assert grid.median_depth_m / 80.0 < grid.voxel_size_m <= grid.median_depth_m / 40.0
    near = dataclasses.replace(every, max_ray_length_m=grid.median_depth_m)
    (of_near,) = fusion.fuse_depth(with_depth, room.map_folder, options=near)[1].grids
    assert of_near.depth_in_range == pytest.approx(0.5, abs=0.1)


def test_the_grid_moves_with_its_mission(room: StereoRoom, with_depth: VIMap) -> None:
    fused, _ = fusion.fuse_depth(with_depth, Path(), None, OPTIONS)
    before, _ = meshing.map_mesh(fused, Path(), None, 0.1)
    T_G_M = np.array(fused.baseframes.T_G_M)
    T_G_M[:, 4:] += [3.0, -2.0, 1.0]
    moved_map = fused.replace(baseframes=fused.baseframes.replace(T_G_M=T_G_M))
    after, _ = meshing.map_mesh(moved_map, Path(), None, 0.1)
    np.testing.assert_allclose(after.p - before.p, [[3.0, -2.0, 1.0]] * len(after.p), atol=1e-9)


def test_clouds_of_cameras_fuse_as_their_depth_maps_do(room: StereoRoom, with_depth: VIMap) -> None:
    clouds, _ = convert_depth_maps(with_depth, Path())
    fused, report = fusion.fuse_depth(clouds, Path(), None, OPTIONS, input_type=16)
    assert report.resource_type == "point_cloud"
    expected, _ = fusion.fuse_depth(with_depth, Path(), None, OPTIONS)
    mesh, same = meshing.map_mesh(fused, Path())[0], meshing.map_mesh(expected, Path())[0]
    assert abs(len(mesh.p) - len(same.p)) < 0.01 * len(same.p)
    assert distances(room, fused).mean() < 1.1 * distances(room, expected).mean() + 1e-4


def test_an_update_gives_what_fusing_again_gives(with_depth: VIMap) -> None:
    wrong = moved(with_depth, slice(3, 8), 0.2)
    fused, _ = fusion.fuse_depth(wrong, Path(), None, OPTIONS)
    right = moved(fused, slice(3, 8), -0.2)
    updated, report = fusion.update_grids(right, Path())
    assert (report.grids[0].added, report.grids[0].removed) == (5, 5)
    (_, stored), (_, direct) = (
        fusion.load_grids(vi_map, Path())[0]
        for vi_map in (updated, fusion.fuse_depth(with_depth, Path(), None, OPTIONS)[0])
    )
    np.testing.assert_allclose(stored.fused.T_M_C, direct.fused.T_M_C, atol=1e-12)
    rows = {tuple(c): row for row, c in enumerate(stored.grid.coordinates.tolist())}
    same = [rows[tuple(c)] for c in direct.grid.coordinates.tolist()]
    np.testing.assert_allclose(stored.grid.weight[same], direct.grid.weight, rtol=1e-3, atol=1e-3)
    strong = direct.grid.weight > 0.5
    difference = (stored.grid.distance[same] - direct.grid.distance)[strong]
    assert np.abs(difference).max() < 1e-3
    assert len(updated.resources) == len(fused.resources)
    again, report = fusion.update_grids(updated, Path())
    assert again is updated
    assert report.grids[0].added == 0


def test_small_motion_is_left_alone(with_depth: VIMap) -> None:
    fused, _ = fusion.fuse_depth(with_depth, Path(), None, OPTIONS)
    shifted = moved(fused, slice(0, 4), 0.02)
    assert fusion.update_grids(shifted, Path(), threshold_m=0.05)[0] is shifted
    _, report = fusion.update_grids(shifted, Path(), threshold_m=0.01)
    assert report.grids[0].added == 4


def test_missions_in_unknown_frames_have_their_own_grids(with_depth: VIMap) -> None:
    both, _ = merge.merge_maps(with_depth, with_depth, assign_new_ids=True)
    apart, report = fusion.fuse_depth(both, Path(), None, OPTIONS)
    assert [grid.missions for grid in report.grids] == [1, 1]
    assert "unknown base frames" in report.notes[0]
    assert (apart.resources.owner_kind[resources_of(apart, (18,))] == ResourceOwner.MISSION).all()
    fields = create_fields(both, Path(), None, fusion=OPTIONS)[1]
    assert [field.missions for field in fields.fields] == [1, 1]
    assert "unknown base frames" in fields.notes[0]
    known = both.replace(
        baseframes=both.baseframes.replace(is_known=np.ones(len(both.baseframes), dtype=bool))
    )
    together, report = fusion.fuse_depth(known, Path(), None, OPTIONS)
    assert [grid.missions for grid in report.grids] == [2]
    assert report.grids[0].depth_maps == 2 * len(with_depth.vertices)
    assert np.count_nonzero(resources_of(together, (18,))) == 1
    assert fusion.update_grids(together, Path())[0] is together


def test_bad_input_is_refused(room: StereoRoom, with_depth: VIMap) -> None:
    with pytest.raises(UserError, match="stereo_dense_reconstruction"):
        fusion.fuse_depth(room.true_map, Path())
    with pytest.raises(UserError, match="have no optimized_depth_maps"):
        fusion.fuse_depth(with_depth, Path(), input_type=9)
    with pytest.raises(UserError, match="wants one of 8, 9, 16"):
        fusion.fuse_depth(with_depth, Path(), input_type=0)
    for function in (fusion.update_grids, meshing.map_mesh):
        with pytest.raises(UserError, match="create_tsdf_from_depth_resource makes one"):
            function(with_depth, Path())
    fused, _ = fusion.fuse_depth(with_depth, Path(), None, OPTIONS)
    with pytest.raises(UserError, match=r"--overwrite.*--update"):
        fusion.fuse_depth(fused, Path(), None, OPTIONS)
    replaced, _ = fusion.fuse_depth(fused, Path(), None, OPTIONS, overwrite=True)
    np.testing.assert_array_equal(replaced.resources.id, fused.resources.id)
    with pytest.raises(EstimationError, match="--dense_tsdf_mesh_min_weight"):
        meshing.map_mesh(fused, Path(), None, 1e9)
    with pytest.raises(MapError, match="depth maps of the grid are not in the map"):
        fusion.update_grids(without_resources(fused, resources_of(fused, (8,))), Path())


def test_grids_of_other_programs_are_refused(with_depth: VIMap) -> None:
    new = NewResources()
    foreign = new.attached(with_depth, [new.add(18, b"\x0a\x05")], [0], ResourceOwner.MISSION)
    with pytest.raises(MapError, match=r"C\+\+ maplab's are not read"):
        meshing.map_mesh(foreign, Path())


@pytest.mark.parametrize(
    ("content", "error", "message"),
    [
        (b"".join(encode_ply(PlyCloud(np.ones((9, 3)))))[:-4], MapError, "end early"),
        (b"hello", MapError, "not a PLY file"),
        (b"".join(encode_ply(PlyCloud(np.zeros((0, 3))))), EstimationError, "without any depth"),
        (b"".join(encode_ply(PlyCloud(np.full((9, 3), np.nan)))), EstimationError, "without any"),
        (
            b"".join(encode_ply(PlyCloud(np.full((9, 3), 50.0)))),
            EstimationError,
            "max_ray_length_m",
        ),
    ],
)
def test_clouds_without_depth_are_refused_in_one_line(
    room: StereoRoom, content: bytes, error: type[Exception], message: str
) -> None:
    new = NewResources()
    vi_map = new.attached(room.true_map, [new.add(16, content)], [0])
    for function in (fusion.fuse_depth, create_fields):
        with pytest.raises(error, match=message) as raised:
            function(vi_map, Path())
        assert "\n" not in str(raised.value)


def test_depth_maps_of_another_size_are_refused(room: StereoRoom) -> None:
    new = NewResources()
    vi_map = new.attached(room.true_map, [new.add_image(np.ones((24, 32), np.uint16), 8)], [0])
    for function in (fusion.fuse_depth, create_fields):
        with pytest.raises(MapError, match="32 x 24 pixels, the images of its camera 376 x 240"):
            function(vi_map, Path())


PINHOLE = pinhole.Pinhole(100.0, (79.5, 59.5), 160, 120)
SETTINGS = GridSettings(0.05, 0.15, 0.1, 6.0, 2, 1e4)
RADIUS_M = 0.6


def looking_at_origin(direction: F64, distance_m: float) -> F64:
    """Return the pose (4, 4) of a camera that looks from a direction at the origin."""
    z = -direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = -z * distance_m
    return T


def depth_of_sphere(T_G_C: F64) -> F32:
    """Return the depths (H, W) of a sphere about the origin; 0 beside it."""
    rays = PINHOLE.rays()
    centre = -T_G_C[:3, :3].T @ T_G_C[:3, 3]
    # |t ray - centre| = radius
    a, b = np.sum(rays**2, axis=-1), rays @ centre
    under_root = b**2 - a * (centre @ centre - RADIUS_M**2)
    t = (b - np.sqrt(np.maximum(under_root, 0.0))) / a
    return np.where(under_root > 0.0, t, 0.0).astype(np.float32)


def directions() -> F64:
    """Return directions (26, 3) all around."""
    steps = np.array([[a, b, c] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)])
    return steps[np.any(steps != 0, axis=1)].astype(np.float64)


def sphere_grid() -> TsdfGrid:
    poses = [looking_at_origin(direction, 2.0) for direction in directions()]
    return grid_of([(depth_of_sphere(T_G_C), PINHOLE, T_G_C) for T_G_C in poses])


def grid_of(views: list[View]) -> TsdfGrid:
    grid = TsdfGrid.unobserved(SETTINGS, blocks_of_views(views, SETTINGS))
    for view in views:
        grid.integrate(*view)
    return grid


def edge_counts(mesh: Mesh) -> np.ndarray:
    """Return by how many triangles each edge is used in one direction minus the other, and in all."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    _, directed = np.unique(edges, axis=0, return_counts=True)
    assert (directed == 1).all(), "two triangles run along an edge in the same direction"
    return counts


def test_a_sphere_is_watertight_and_looks_outwards() -> None:
    mesh = sphere_grid().mesh(0.1)
    radii = np.linalg.norm(mesh.p, axis=1)
    # distances along the optical axis are too long where a ray grazes the sphere
    assert np.abs(radii - RADIUS_M).max() < 0.2 * SETTINGS.voxel_size_m
    assert np.abs(radii - RADIUS_M).mean() < 0.1 * SETTINGS.voxel_size_m
    assert (edge_counts(mesh) == 2).all()
    corners = mesh.p[mesh.faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    volume = np.einsum("fi,fi->", areas, corners.mean(axis=1)) / 3.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * RADIUS_M**3, rel=0.02)
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    euler = len(mesh.p) - len(edges) + len(mesh.faces)
    assert euler == 2


def test_no_triangle_touches_an_unobserved_cell() -> None:
    grid = sphere_grid()
    min_weight = 0.5
    observed = {}
    for block, coordinate in enumerate(grid.coordinates):
        for voxel in np.argwhere(grid.weight[block] >= min_weight):
            observed[tuple(8 * coordinate + voxel)] = True
    mesh = grid.mesh(min_weight)
    cells = np.floor(mesh.p / SETTINGS.voxel_size_m - 0.5).astype(int)
    offsets = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    assert all(tuple(cell + offset) in observed for cell in cells for offset in offsets)


def test_the_rim_of_the_band_is_no_surface() -> None:
    depth = np.zeros((120, 160), dtype=np.float32)
    depth[40:80, 60:100] = 2.0  # a patch that hangs in unknown space
    mesh = grid_of([(depth, PINHOLE, np.eye(4))]).mesh(0.1)
    np.testing.assert_allclose(mesh.p[:, 2], 2.0, atol=1e-3)


def test_one_thread_and_more_give_the_same_bytes() -> None:
    before = numba.get_num_threads()
    contents = []
    for threads in (1, before):
        numba.set_num_threads(threads)
        grid = sphere_grid()
        contents.append(
            (grid.distance.tobytes(), grid.weight.tobytes(), grid.mesh(0.1).p.tobytes())
        )
    numba.set_num_threads(before)
    assert contents[0] == contents[1]


def test_a_depth_map_that_is_taken_out_leaves_no_trace() -> None:
    grid = sphere_grid()
    wrong = looking_at_origin(np.array([1.0, 0.2, 0.1]), 1.7)
    depth = depth_of_sphere(looking_at_origin(np.array([1.0, 0.2, 0.1]), 2.0))
    weight, distance = grid.weight.copy(), grid.distance.copy()
    grid.integrate(depth, PINHOLE, wrong)
    assert not np.allclose(grid.weight, weight)
    grid.integrate(depth, PINHOLE, wrong, sign=-1.0)
    np.testing.assert_allclose(grid.weight, weight, atol=1e-5)
    seen = weight > 0.01
    np.testing.assert_allclose(grid.distance[seen], distance[seen], atol=1e-4)


def stored_sphere() -> fusion.StoredGrid:
    fused = fusion.FusedDepth(np.array([[1, 2], [3, 4]], dtype=np.uint64), np.ones((2, 7)))
    return fusion.StoredGrid(sphere_grid(), fused)


def test_a_grid_file_holds_everything() -> None:
    stored = stored_sphere()
    data = fusion.encode_grid(stored)
    loaded = fusion.decode_grid(data, "grid")
    assert loaded.grid.settings == SETTINGS
    np.testing.assert_array_equal(loaded.fused.resource_id, stored.fused.resource_id)
    assert fusion.encode_grid(loaded) == data
    mesh, again = stored.grid.mesh(0.1), loaded.grid.mesh(0.1)
    assert mesh.p.tobytes() == again.p.tobytes()
    assert mesh.faces.tobytes() == again.faces.tobytes()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"", "no grid of maplab-py"),
        (lambda data: b"voxblox" + data, "no grid of maplab-py"),
        (lambda data: data[:-1], "damaged or ends early"),
        (lambda data: data[:5000] + bytes([data[5000] ^ 1]) + data[5001:], "damaged or ends early"),
        (lambda data: data.replace(b'"blocks"', b'"bricks"'), "header of the grid is damaged"),
        (lambda data: data[:30], "header of the grid is damaged"),
    ],
)
def test_damaged_files_are_refused(damage: object, message: str) -> None:
    data = damage(fusion.encode_grid(stored_sphere()))  # type: ignore[operator]
    with pytest.raises(MapError, match=message) as error:
        fusion.decode_grid(data, "grid 7")
    assert str(error.value).startswith("grid 7: ")


def test_memory_is_bounded() -> None:
    settings = dataclasses.replace(SETTINGS, voxel_size_m=0.002, truncation_m=0.006)
    T_G_C = looking_at_origin(np.array([1.0, 0.0, 0.0]), 2.0)
    with (
        memory_limited(0.006, "--dense_max_memory_gb"),
        pytest.raises(NotEnoughMemory, match="--dense_max_memory_gb"),
    ):
        blocks_of_views([(depth_of_sphere(T_G_C), PINHOLE, T_G_C)], settings)


def test_blocks_are_the_same_however_many_are_looked_for_at_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    T_G_C = looking_at_origin(np.array([1.0, 0.0, 0.0]), 2.0)
    view = depth_of_sphere(T_G_C), PINHOLE, T_G_C
    expected = blocks_of_views([view], SETTINGS, with_free_space=True)
    monkeypatch.setattr("maplab_py.algorithms.dense.grid._MOST_BLOCKS", 3)
    blocks = blocks_of_views([view], SETTINGS, with_free_space=True)
    np.testing.assert_array_equal(blocks, expected)


def test_places_beyond_the_grid_are_refused() -> None:
    T_G_C = np.eye(4)
    T_G_C[0, 3] = 1e6
    with pytest.raises(MapError, match="larger voxels"):
        blocks_of_views([(np.ones((120, 160), dtype=np.float32), PINHOLE, T_G_C)], SETTINGS)


def test_an_empty_grid_has_no_surface() -> None:
    mesh = grid_of([]).mesh(1.0)
    assert mesh.p.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)
