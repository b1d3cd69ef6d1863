"""The file of a coloured mesh, read with another program's reader."""

from __future__ import annotations

import io

import numpy as np
import pytest

from maplab_py.viewer.display.parts import coloured_glb, is_coloured
from maplab_py.viewer.scene import Mesh


def test_a_reader_sees_corners_triangles_and_colours() -> None:
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(0)
    p = rng.normal(size=(7, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 3, 4], [4, 5, 6]], dtype=np.int32)
    colours = np.array([[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 188, 0]] + 3 * [[5, 5, 5]])
    mesh = Mesh(p, faces, colours.astype(np.uint8))
    assert is_coloured(mesh)
    data = coloured_glb(mesh)
    read = trimesh.load(io.BytesIO(data), file_type="glb", force="mesh", process=False)
    np.testing.assert_array_equal(read.vertices.astype(np.float32), p)
    np.testing.assert_array_equal(read.faces, faces)
    assert len(data) % 4 == 0


def test_a_mesh_of_one_colour_is_none() -> None:
    mesh = Mesh(np.zeros((3, 3), np.float32), np.zeros((1, 3), np.int32), np.zeros(3, np.uint8))
    assert not is_coloured(mesh)
