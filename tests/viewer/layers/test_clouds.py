"""Legends of dense clouds and meshes."""

from __future__ import annotations

import numpy as np

from maplab_py.viewer import colours
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.scene import LegendEntry, Mesh, Points, Scene
from tests.vimap.builders import walk_map

RAMP = tuple(colours.hex_codes(colours.SEQUENTIAL))


def _scene(*clouds: Cloud) -> Scene:
    return build_scene(Subject(walk_map(), "test", clouds=clouds))


def _line(low: float, high: float) -> np.ndarray:
    p = np.zeros((200, 3))
    p[:, 2] = np.linspace(low, high, 200)
    return p


def test_clouds_of_one_title_share_one_ramp_and_its_legend() -> None:
    scene = _scene(Cloud("scan", _line(0.0, 1.0)), Cloud("scan", _line(9.0, 10.0)))
    layer = scene.layer("cloud_0")
    (entry,) = layer.legend
    assert entry.text == "scan: height"
    assert entry.colours == RAMP
    assert float(entry.low.removesuffix(" m")) < 0.1
    assert float(entry.high.removesuffix(" m")) > 9.9
    part = layer.parts[""]
    assert isinstance(part, Points)
    low = part.colours[part.p[:, 2] <= 1.0]
    assert (np.abs(low.astype(int) - colours.SEQUENTIAL[0]).max(axis=1) < 60).all()


def test_intensity_has_no_unit() -> None:
    intensity = np.linspace(0.0, 250.0, 200)
    (entry,) = _scene(Cloud("lidar", _line(0.0, 1.0), intensity=intensity)).layer("cloud_0").legend
    assert entry.text == "lidar: intensity"
    assert float(entry.high) > 240.0


def test_own_colours_need_no_legend() -> None:
    own = np.full((200, 3), 80, dtype=np.uint8)
    assert _scene(Cloud("photo", _line(0.0, 1.0), own)).layer("cloud_0").legend == ()


def test_a_mesh_in_one_colour_has_a_swatch() -> None:
    faces = np.array([[0, 1, 2]], dtype=np.int32)
    layer = _scene(Cloud("mesh", _line(0.0, 1.0), faces=faces)).layer("mesh_0")
    mesh = layer.parts[""]
    assert isinstance(mesh, Mesh)
    assert layer.legend == (LegendEntry("mesh", (colours.to_hex(mesh.colours),)),)
