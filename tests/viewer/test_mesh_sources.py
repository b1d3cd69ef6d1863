"""Colours of meshes by every rule, slices of distance fields, files of meshes."""

import io
import json
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.dense.field import FIELD_TYPE, DistanceField, encode_field
from maplab_py.errors import UserError
from maplab_py.interop.mesh_files import shown_glb
from maplab_py.storage.resources.new import NewResources
from maplab_py.viewer import colours
from maplab_py.viewer.colours import linear_light
from maplab_py.viewer.display.parts import is_coloured
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.mesh_sources import coloured_mesh, field_slice
from maplab_py.viewer.resource_clouds import VertexImages, depth_picture
from maplab_py.viewer.scene import Mesh
from maplab_py.vimap import ResourceOwner, VIMap
from tests.vimap.builders import walk_map

SQUARE = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 2.0]])
FACES = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
OWN = np.arange(12, dtype=np.uint8).reshape(4, 3)
GROUND = np.array([[-9.0, -9.0, -1.0], [9.0, -9.0, -1.0], [0.0, 9.0, -1.0]])


def test_rules_for_the_colours_of_a_mesh() -> None:
    mesh = Cloud("room", SQUARE, OWN, faces=FACES)
    ground = Cloud("ground", GROUND, faces=FACES[:1])
    for rule in ("auto", "colour"):
        assert coloured_mesh(mesh, rule).colours is OWN
    assert coloured_mesh(mesh, "shaded").colours is None
    height = coloured_mesh(mesh, "height")
    assert height.colours is not None
    np.testing.assert_array_equal(height.colours[[0, 3]], colours.SEQUENTIAL[[0, -1]])
    assert (height.legend[0].text, height.legend[0].low) == ("height", "0 m")
    distance = coloured_mesh(mesh, "distance", ground)
    assert distance.colours is not None
    # 1 m for three vertices, 3 m for the fourth
    np.testing.assert_array_equal(distance.colours[0], distance.colours[2])
    np.testing.assert_array_equal(distance.colours[3], colours.HEAT[-1])
    assert distance.legend[0].text == "distance"
    assert coloured_mesh(mesh, "auto", ground).legend == distance.legend


def test_rules_that_lack_something_are_refused() -> None:
    mesh = Cloud("room", SQUARE, faces=FACES)
    with pytest.raises(UserError, match="--mesh_reference_file"):
        coloured_mesh(mesh, "distance")
    with pytest.raises(UserError, match="has no colours"):
        coloured_mesh(mesh, "colour")


def test_the_depth_of_a_vertex_is_below_its_image(tmp_path: Path) -> None:
    depth = np.full((60, 80), 2000, dtype=np.uint16)
    depth[:, 40:] = 4000
    depth[30:, :20] = 0
    new = NewResources(tmp_path)
    rows = [
        new.add_image(np.full((60, 80), 200, dtype=np.uint8)),
        new.add_image(depth, 8),
        new.add_image(depth, 8),
    ]
    vi_map = walk_map(vertices=3, landmarks=4)
    frames = np.array([vi_map.frame_start[0], vi_map.frame_start[0], vi_map.frame_start[1]])
    vi_map = new.attached(vi_map, rows, frames)
    images = VertexImages(vi_map, Path(), with_depth=True)
    assert len(images) == 2
    picture = images(0)
    assert picture is not None
    assert picture.shape == (120, 80, 3)
    assert (picture[:60] == 200).all()
    np.testing.assert_array_equal(picture[115, 30], colours.SEQUENTIAL[-1])  # near
    np.testing.assert_array_equal(picture[115, 60], colours.SEQUENTIAL[0])  # far
    assert (picture[115, 5] == 0).all()  # unknown
    only_depth = images(1)
    assert only_depth is not None
    np.testing.assert_array_equal(only_depth, picture[60:])
    assert images(2) is None
    plain = VertexImages(vi_map, Path())(0)
    assert plain is not None
    assert plain.shape == (60, 80, 3)


def test_a_depth_map_without_depth() -> None:
    picture = depth_picture(np.zeros((60, 80), dtype=np.uint16), 160)
    assert picture.shape == (120, 160, 3)


@pytest.fixture
def vi_map(tmp_path: Path) -> VIMap:
    """Return a map with a field of one block that grows with the height; one voxel is unknown."""
    distance = np.zeros((1, 8, 8, 8), dtype=np.float32) + 0.1 * np.arange(8, dtype=np.float32)
    distance[0, 2, 3, 4] = np.nan
    field = DistanceField(0.1, 2.0, np.zeros((1, 3), dtype=np.int32), distance)
    new = NewResources(tmp_path)
    rows = [new.add(FIELD_TYPE, encode_field(field))]
    plain = walk_map(vertices=3, landmarks=4)
    T_G_M = np.array(plain.baseframes.T_G_M)
    T_G_M[:] = [0.0, 0.0, 0.0, 1.0, 5.0, 0.0, 1.0]
    plain = plain.replace(baseframes=plain.baseframes.replace(T_G_M=T_G_M))
    return new.attached(plain, rows, [0], ResourceOwner.MISSION)


def test_a_slice_has_the_known_voxels_of_its_height(vi_map: VIMap) -> None:
    cloud = field_slice(vi_map, Path(), None, 1.45)
    assert cloud.p_G.shape == (63, 3)
    np.testing.assert_allclose(cloud.p_G[:, 2], 1.45)
    assert cloud.p_G[:, 0].min() == pytest.approx(5.05)
    assert (cloud.legend[0].low, cloud.legend[0].high) == ("0.4 m", "0.4 m")
    between = field_slice(vi_map, Path(), None, 1.40)
    assert len(between.p_G) == 63 + 64
    assert between.colours is not None
    nearest = np.argmin(between.p_G[:, 2])
    np.testing.assert_array_equal(between.colours[nearest], colours.SEQUENTIAL[-1])


def test_heights_without_voxels_are_refused(vi_map: VIMap) -> None:
    with pytest.raises(UserError, match=r"has voxels from 1\.05 m to 1\.75 m"):
        field_slice(vi_map, Path(), None, 3.0)


def test_a_reader_sees_corners_triangles_and_colours() -> None:
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(0)
    p = rng.normal(size=(7, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4], [4, 5, 6]], dtype=np.int32)
    colours = np.array([[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 188, 0]] + 3 * [[5, 5, 5]])
    mesh = Mesh(p, faces, colours.astype(np.uint8))
    assert is_coloured(mesh)
    data = shown_glb(p, faces, linear_light(mesh.colours), 1.0)
    read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh", process=False)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), p)
    np.testing.assert_array_equal(read.faces, faces)
    length = int.from_bytes(data[12:16], "little")
    content = json.loads(data[20 : 20 + length])
    accessor = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    start = 28 + length + content["bufferViews"][accessor["bufferView"]]["byteOffset"]
    linear = np.frombuffer(data, "<f4", 21, start).reshape(7, 3)
    np.testing.assert_allclose(linear[3], [0.0, 0.5029, 0.0], atol=1e-4)
    np.testing.assert_allclose(linear[4:], 5.0 / 255.0 / 12.92, rtol=1e-5)  # 8 bits cannot say this


def test_a_mesh_of_one_colour_is_none() -> None:
    mesh = Mesh(np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32), np.zeros(3, np.uint8))
    assert not is_coloured(mesh)
