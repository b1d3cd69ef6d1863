"""Grid, scale bar, labels of ends, colours of missions."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplab_py.storage.mission_names import named
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display.camera import FIELD_OF_VIEW_RAD, view_of, window_of
from maplab_py.viewer.drawing import PATH_ENDS, make_drawing, with_end_labels
from maplab_py.viewer.ground import cell_size_m, make_ground
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import Extent, Points, Scene
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import simulated
from tests.vimap.builders import walk_map


def _extent(low: np.ndarray, high: np.ndarray) -> Extent:
    outline = np.array([low, high])
    radius = 0.5 * float(np.linalg.norm(high - low))
    return Extent(0.5 * (low + high), radius, float(low[2]), outline)


@pytest.mark.parametrize(("radius", "cell"), [(0.5, 0.1 * 5), (1.0, 0.2), (30.0, 5.0), (240, 20)])
def test_cells_are_round(radius: float, cell: float) -> None:
    assert cell_size_m(radius) == pytest.approx(0.05 if radius == 0.5 else cell)


@pytest.mark.parametrize("origin", [np.zeros(3), np.array([4_000.0, -7_000.0, 100.0])])
def test_labels_name_coordinates_of_the_global_frame(origin: np.ndarray) -> None:
    low, high = np.array([-13.2, 4.1, -1.0]), np.array([21.7, 30.0, 2.5])
    ground = make_ground(_extent(low, high), origin)
    lines = dict(zip(ground.labels, ground.p_labels, strict=True))
    axes = {label: p for label, p in lines.items() if label[:1] in "xy"}
    assert 4 <= len([label for label in axes if label.startswith("x")]) <= 8
    for label, p in axes.items():
        axis = "xy".index(label[0])
        assert p[axis] + origin[axis] == pytest.approx(float(label[2:]))
        assert (p[axis] + origin[axis]) / ground.cell_m == pytest.approx(
            round((p[axis] + origin[axis]) / ground.cell_m)
        )
    assert not {"x -0", "y -0"} & set(lines)
    assert f"z {2.5 + origin[2]:.1f}" in lines
    crossing = (ground.position + origin)[:2] / ground.section_m
    np.testing.assert_allclose(crossing, np.round(crossing), atol=1e-9)


def test_the_bar_is_as_long_as_it_says() -> None:
    ground = make_ground(_extent(np.zeros(3), np.array([70.0, 20.0, 3.0])), np.zeros(3))
    length = float(np.linalg.norm(ground.bar.ends[0, 1] - ground.bar.ends[0, 0]))
    assert ground.labels[-1] == f"{length:g} m"
    assert ground.axes.ends[:, 0].min() >= -ground.cell_m


def test_coordinates_at_a_corner_share_a_label() -> None:
    ground = make_ground(_extent(np.zeros(3), np.array([60.0, 60.0, 3.0])), np.zeros(3))
    assert ground.labels[0] == "x 0, y 0"
    assert "y 0" not in ground.labels


PHONE, TABLET, WIDE = (390, 844), (800, 900), (1440, 900)


@pytest.mark.parametrize("size_px", [PHONE, TABLET, WIDE])
@pytest.mark.parametrize(
    "size_m", [(45.0, 20.0, 4.0), (11.0, 9.0, 6.0), (4.0, 5.0, 2.5), (300.0, 80.0, 20.0)]
)
def test_labels_do_not_overlap(
    size_m: tuple[float, float, float], size_px: tuple[int, int]
) -> None:
    low = np.array([-3.1, -11.0, -1.2])
    corners = low + np.array(list(itertools.product((0.0, 1.0), repeat=3))) * size_m
    seen = dataclasses.replace(_extent(low, low + size_m), outline=corners)
    ground = make_ground(seen, np.zeros(3))
    page: Any = SimpleNamespace(aspect=size_px[0] / size_px[1])
    eye, target = view_of(seen, beside_panel=True, window=window_of(page))
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    p = (ground.p_labels - eye) @ np.stack([right, np.cross(back, right), back]).T
    at_px = p[:, :2] / -p[:, 2:] * 0.5 * size_px[1] / np.tan(0.5 * FIELD_OF_VIEW_RAD)
    width_px = 6.0 * np.array([len(label) for label in ground.labels])
    for a, b in itertools.combinations(range(len(at_px)), 2):
        left, other = (a, b) if at_px[a, 0] <= at_px[b, 0] else (b, a)
        is_beside = at_px[left, 0] + width_px[left] <= at_px[other, 0]
        is_above = abs(at_px[a, 1] - at_px[b, 1]) >= 11.0
        assert is_beside or is_above, (ground.labels[a], ground.labels[b])


def test_a_map_without_height_has_no_upright_label() -> None:
    ground = make_ground(_extent(np.zeros(3), np.array([1.0, 0.0, 0.0])), np.zeros(3))
    assert not any(label.startswith("z") for label in ground.labels)


def _scene(ends: dict[str, list[list[float]]]) -> Scene:
    """Return a scene of 10 m radius with paths that start and end at given places."""
    scene = build_scene(Subject(walk_map()))
    layer = scene.layer(PATH_ENDS)
    (dots,) = layer.parts.values()
    assert isinstance(dots, Points)
    parts = {
        name: dataclasses.replace(
            dots, p=np.array(p, dtype=np.float32), labels=(f"start {name}", f"end {name}")
        )
        for name, p in ends.items()
    }
    layers = (dataclasses.replace(layer, parts=parts),)
    extent = dataclasses.replace(scene.extent, radius_m=10.0)
    return dataclasses.replace(scene, layers=layers, extent=extent)


def _labels(scene: Scene) -> dict[str, tuple[str, ...]]:
    parts = scene.layer(PATH_ENDS).parts
    return {name: part.labels for name, part in parts.items() if isinstance(part, Points)}


SCENE = _scene(
    {"a": [[0, 0, 0], [9, 0, 0]], "b": [[0.5, 0, 0], [0, 9, 0]], "c": [[9, 1, 0], [0, 0, 1]]}
)


def test_ends_close_together_are_lines_of_one_label() -> None:
    assert _labels(with_end_labels(SCENE, {"a", "b", "c"})) == {
        "a": ("start a\nstart b\nend c", "end a\nstart c"),
        "b": ("", "end b"),
        "c": (),
    }


def test_hidden_missions_have_no_label() -> None:
    labels = _labels(with_end_labels(SCENE, {"b", "c"}))
    assert labels["b"] == ("start b\nend c", "end b")
    assert labels["c"] == ("start c", "")


def test_missions_of_one_robot_have_one_colour_if_that_is_wanted() -> None:
    first, second = simulated().maps
    three, _ = merge_maps(merge_maps(first, second)[0], first, assign_new_ids=True)
    three = named(three, ["ant", "bee", "ant"])
    colours = make_drawing(three, VisualizationOptions()).mission_colours
    assert len(np.unique(colours, axis=0)) == 3
    by_name = make_drawing(three, VisualizationOptions(color_missions_by_name=True))
    assert np.array_equal(by_name.mission_colours, colours[[0, 1, 0]])
    unnamed = make_drawing(named(three, ["", "", ""]), by_name.options)
    assert np.array_equal(unnamed.mission_colours, colours)
