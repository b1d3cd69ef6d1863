"""Colours of meshes by every rule, and pictures of vertices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.storage.resources.new import NewResources
from maplab_py.viewer import colours
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.mesh_sources import coloured_mesh
from maplab_py.viewer.resource_clouds import VertexImages, depth_picture
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
