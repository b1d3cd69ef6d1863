"""The grid, its coordinates and the scale bar."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.viewer.ground import cell_size_m, make_ground
from maplab_py.viewer.scene import Extent


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


def test_a_map_without_height_has_no_upright_label() -> None:
    ground = make_ground(_extent(np.zeros(3), np.array([1.0, 0.0, 0.0])), np.zeros(3))
    assert not any(label.startswith("z") for label in ground.labels)
