"""Fusion of true depth against the true surfaces; updates, several missions, bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.dense.clouds import convert_depth_maps
from maplab_py.algorithms.dense.field import create_fields
from maplab_py.algorithms.dense.fusion import fuse_depth, load_grids, update_grids
from maplab_py.algorithms.dense.meshing import map_mesh
from maplab_py.algorithms.dense.options import FusionOptions
from maplab_py.array_types import F64
from maplab_py.errors import EstimationError, MapError, UserError
from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.interop.resources.depth_maps import import_depth_maps
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import ResourceOwner, VIMap
from maplab_py.vimap.merge import merge_maps
from maplab_py.vimap.resource_queries import resources_of, without_resources
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
    mesh, _ = map_mesh(vi_map, Path(), None, min_weight)
    return room.distances_to_surfaces(mesh.p)


def test_true_depth_gives_the_true_surfaces(room: StereoRoom, with_depth: VIMap) -> None:
    fused, report = fuse_depth(with_depth, Path(), None, FusionOptions(voxel_size_m=0.05))
    assert report.resource_type == "raw_depth_maps"
    assert report.grids[0].added == len(with_depth.vertices)
    off_m = distances(room, fused)
    assert len(off_m) > 5000
    assert off_m.mean() < 0.0025
    assert np.percentile(off_m, 90) < 0.004
    assert np.mean(off_m > 0.1) < 0.001


def test_the_grid_moves_with_its_mission(room: StereoRoom, with_depth: VIMap) -> None:
    fused, _ = fuse_depth(with_depth, Path(), None, OPTIONS)
    before, _ = map_mesh(fused, Path(), None, 0.1)
    T_G_M = np.array(fused.baseframes.T_G_M)
    T_G_M[:, 4:] += [3.0, -2.0, 1.0]
    moved_map = fused.replace(baseframes=fused.baseframes.replace(T_G_M=T_G_M))
    after, _ = map_mesh(moved_map, Path(), None, 0.1)
    np.testing.assert_allclose(after.p - before.p, [[3.0, -2.0, 1.0]] * len(after.p), atol=1e-9)


def test_clouds_of_cameras_fuse_as_their_depth_maps_do(room: StereoRoom, with_depth: VIMap) -> None:
    clouds, _ = convert_depth_maps(with_depth, Path())
    fused, report = fuse_depth(clouds, Path(), None, OPTIONS, input_type=16)
    assert report.resource_type == "point_cloud"
    expected, _ = fuse_depth(with_depth, Path(), None, OPTIONS)
    mesh, same = map_mesh(fused, Path())[0], map_mesh(expected, Path())[0]
    assert abs(len(mesh.p) - len(same.p)) < 0.01 * len(same.p)
    assert distances(room, fused).mean() < 1.1 * distances(room, expected).mean() + 1e-4


def test_an_update_gives_what_fusing_again_gives(with_depth: VIMap) -> None:
    wrong = moved(with_depth, slice(3, 8), 0.2)
    fused, _ = fuse_depth(wrong, Path(), None, OPTIONS)
    right = moved(fused, slice(3, 8), -0.2)
    updated, report = update_grids(right, Path())
    assert (report.grids[0].added, report.grids[0].removed) == (5, 5)
    (_, stored), (_, direct) = (
        load_grids(vi_map, Path())[0]
        for vi_map in (updated, fuse_depth(with_depth, Path(), None, OPTIONS)[0])
    )
    np.testing.assert_allclose(stored.fused.T_M_C, direct.fused.T_M_C, atol=1e-12)
    rows = {tuple(c): row for row, c in enumerate(stored.grid.coordinates.tolist())}
    same = [rows[tuple(c)] for c in direct.grid.coordinates.tolist()]
    np.testing.assert_allclose(stored.grid.weight[same], direct.grid.weight, rtol=1e-3, atol=1e-3)
    strong = direct.grid.weight > 0.5
    difference = (stored.grid.distance[same] - direct.grid.distance)[strong]
    assert np.abs(difference).max() < 1e-3
    assert len(updated.resources) == len(fused.resources)
    again, report = update_grids(updated, Path())
    assert again is updated
    assert report.grids[0].added == 0


def test_small_motion_is_left_alone(with_depth: VIMap) -> None:
    fused, _ = fuse_depth(with_depth, Path(), None, OPTIONS)
    shifted = moved(fused, slice(0, 4), 0.02)
    assert update_grids(shifted, Path(), threshold_m=0.05)[0] is shifted
    _, report = update_grids(shifted, Path(), threshold_m=0.01)
    assert report.grids[0].added == 4


def test_missions_in_unknown_frames_have_their_own_grids(with_depth: VIMap) -> None:
    both, _ = merge_maps(with_depth, with_depth, assign_new_ids=True)
    apart, report = fuse_depth(both, Path(), None, OPTIONS)
    assert [grid.missions for grid in report.grids] == [1, 1]
    assert "unknown base frames" in report.notes[0]
    assert (apart.resources.owner_kind[resources_of(apart, (18,))] == ResourceOwner.MISSION).all()
    fields = create_fields(both, Path(), None, fusion=OPTIONS)[1]
    assert [field.missions for field in fields.fields] == [1, 1]
    assert "unknown base frames" in fields.notes[0]
    known = both.replace(
        baseframes=both.baseframes.replace(is_known=np.ones(len(both.baseframes), dtype=bool))
    )
    together, report = fuse_depth(known, Path(), None, OPTIONS)
    assert [grid.missions for grid in report.grids] == [2]
    assert report.grids[0].depth_maps == 2 * len(with_depth.vertices)
    assert np.count_nonzero(resources_of(together, (18,))) == 1
    assert update_grids(together, Path())[0] is together


def test_bad_input_is_refused(room: StereoRoom, with_depth: VIMap) -> None:
    with pytest.raises(UserError, match="stereo_dense_reconstruction"):
        fuse_depth(room.true_map, Path())
    with pytest.raises(UserError, match="have no optimized_depth_maps"):
        fuse_depth(with_depth, Path(), input_type=9)
    with pytest.raises(UserError, match="wants one of 8, 9, 16"):
        fuse_depth(with_depth, Path(), input_type=0)
    for function in (update_grids, map_mesh):
        with pytest.raises(UserError, match="create_tsdf_from_depth_resource makes one"):
            function(with_depth, Path())
    fused, _ = fuse_depth(with_depth, Path(), None, OPTIONS)
    with pytest.raises(UserError, match=r"--overwrite.*--update"):
        fuse_depth(fused, Path(), None, OPTIONS)
    replaced, _ = fuse_depth(fused, Path(), None, OPTIONS, overwrite=True)
    np.testing.assert_array_equal(replaced.resources.id, fused.resources.id)
    with pytest.raises(EstimationError, match="--dense_tsdf_mesh_min_weight"):
        map_mesh(fused, Path(), None, 1e9)
    with pytest.raises(MapError, match="depth maps of the grid are not in the map"):
        update_grids(without_resources(fused, resources_of(fused, (8,))), Path())


def test_grids_of_other_programs_are_refused(with_depth: VIMap) -> None:
    new = NewResources()
    foreign = new.attached(with_depth, [new.add(18, b"\x0a\x05")], [0], ResourceOwner.MISSION)
    with pytest.raises(MapError, match=r"C\+\+ maplab's are not read"):
        map_mesh(foreign, Path())


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
    for function in (fuse_depth, create_fields):
        with pytest.raises(error, match=message) as raised:
            function(vi_map, Path())
        assert "\n" not in str(raised.value)


def test_depth_maps_of_another_size_are_refused(room: StereoRoom) -> None:
    new = NewResources()
    vi_map = new.attached(room.true_map, [new.add_image(np.ones((24, 32), np.uint16), 8)], [0])
    for function in (fuse_depth, create_fields):
        with pytest.raises(MapError, match="32 x 24 pixels, the images of its camera 376 x 240"):
            function(vi_map, Path())
