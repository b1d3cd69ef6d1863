"""Surfaces that appear and vanish where a box comes into a rendered room."""

from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.dense.changes import changed_surfaces
from maplab_py.algorithms.dense.field import create_fields
from maplab_py.algorithms.dense.fusion import fuse_depth
from maplab_py.algorithms.dense.options import FusionOptions
from maplab_py.algorithms.dense.resources import FrameResources
from maplab_py.array_types import F64
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.ply import parse_ply
from maplab_py.interop.resources.depth_maps import RAW_DEPTH_MAPS, encoded_depth, import_depth_maps
from maplab_py.sensors.projection import back_project
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import VIMap, edits, resources_of, without_resources
from tests.support.stereo_room import StereoRoom

OPTIONS = FusionOptions(voxel_size_m=0.08)
SIZE_M, NEAR_M = 0.5, 0.08
"""Side of the box, and how far its surfaces may be from it."""


def with_voxels(vi_map: VIMap) -> tuple[VIMap, Path]:
    fused, _ = fuse_depth(vi_map, Path(), None, OPTIONS)
    return create_fields(fused, Path(), None, None, OPTIONS)[0], Path()


def place_in_view(vi_map: VIMap) -> F64:
    """Return a place half way to what the camera of the middle frame looks at."""
    row = np.flatnonzero(resources_of(vi_map, (RAW_DEPTH_MAPS,)))[len(vi_map.vertices) // 2]
    images = FrameResources(vi_map, Path())
    depth = images.depth(int(row))
    ahead = 0.5 * float(depth[depth.shape[0] // 2, depth.shape[1] // 2])
    T_G_C = images.T_G_C(int(vi_map.resources.owner[row]))
    return se3.transform(T_G_C, np.array([0.0, 0.0, ahead]))


def with_box(vi_map: VIMap, centre: F64) -> VIMap:
    """Return the map with depth maps that a box hides a part of."""
    kept = resources_of(vi_map, (RAW_DEPTH_MAPS,))
    rows, images = np.flatnonzero(kept), FrameResources(vi_map, Path())
    new = NewResources(seed=b"box")
    for row in rows.tolist():
        frame, depth = int(vi_map.resources.owner[row]), images.depth(row)
        v, u = np.indices(depth.shape)
        uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(np.float64)
        ray_C, _ = back_project(images.camera(frame), uv)
        ray_C = ray_C / ray_C[:, 2:]
        T_G_C = images.T_G_C(frame)
        ray_G = so3.rotate(T_G_C[:4], ray_C)
        ends = [(centre + side * SIZE_M / 2 - T_G_C[4:]) / ray_G for side in (-1.0, 1.0)]
        near, far = np.minimum(*ends).max(axis=1), np.maximum(*ends).min(axis=1)
        hit = np.where((near < far) & (near > 0.0), near, np.inf).reshape(depth.shape)
        new.add(RAW_DEPTH_MAPS, encoded_depth(np.minimum(depth, hit).astype(np.float32)))
    owners = vi_map.resources.owner[rows]
    return new.attached(without_resources(vi_map, kept), np.arange(len(rows)), owners)


def test_a_box_appears_and_vanishes(tmp_path: Path) -> None:
    room = StereoRoom.simulated(tmp_path)
    empty = import_depth_maps(room.true_map, 0, 0, room.depth())[0]
    centre = place_in_view(empty)
    before, after = with_voxels(empty), with_voxels(with_box(empty, centre))
    appeared, vanished = changed_surfaces(before, after)
    assert len(appeared.faces) > 50
    assert np.abs(appeared.p - centre).max() < 0.5 * SIZE_M + NEAR_M
    assert np.ptp(appeared.p, axis=0).max() > 0.8 * SIZE_M
    assert len(vanished.faces) == 0
    gone, came = changed_surfaces(after, before)[::-1]
    np.testing.assert_array_equal(gone.p, appeared.p)
    assert len(came.faces) == 0


def test_meshes_of_changes_are_written(tmp_path: Path) -> None:
    room = StereoRoom.simulated(tmp_path / "room")
    empty = import_depth_maps(room.true_map, 0, 0, room.depth())[0]
    known = empty.baseframes.replace(is_known=np.ones(1, dtype=np.bool_))
    empty = empty.replace(baseframes=known)
    before, after = with_voxels(empty)[0], with_voxels(with_box(empty, place_in_view(empty)))[0]
    session = Session()
    session.maps.add("tuesday", edits.with_new_ids(after, np.random.default_rng(0)))
    session.maps.add("monday", before)
    flags = {"other_map": "tuesday", "change_meshes": tmp_path}
    with pytest.raises(UserError, match="wants --changes"):
        session.run("compare_maps", **flags)
    session.run("compare_maps", changes=True, **flags)
    mesh = parse_ply((tmp_path / "appeared.ply").read_bytes(), "appeared.ply")
    assert np.ptp(mesh.p, axis=0).max() > 0.8 * SIZE_M
    session.maps.add("bare", room.true_map.replace(baseframes=known))
    with pytest.raises(UserError, match="grids and distance fields"):
        session.run("compare_maps", changes=True, overwrite=True, **flags)
