"""Plots of the time line."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np

from maplab_py.viewer.display.playback_control import image_tag, plot_paths, strip_chart, value_text
from maplab_py.viewer.playback import Signal

ALL = np.arange(50)


def _corners(path: str) -> np.ndarray:
    return np.array([[float(x), float(y)] for x, y in re.findall(r"[ML](\S+) (-?\d+)", path)])


def _signal(values: np.ndarray) -> Signal:
    return Signal("speed", "m/s", values.reshape(len(values), -1), 2)


def test_a_curve_rises_where_the_value_does() -> None:
    (path,) = plot_paths(_signal(np.linspace(-3.0, 3.0, 50)), ALL, np.linspace(0.0, 1.0, 50))
    corners = _corners(path)
    assert path.count("M") == 1
    assert len(corners) == 50
    assert (np.diff(corners[:, 0]) > 0).all()
    assert (np.diff(corners[:, 1]) <= 0).all()  # SVG counts y downwards
    assert corners[0, 0] == 0.0
    assert corners[-1, 0] == 1000.0


def test_unknown_values_are_gaps() -> None:
    values = np.sin(np.arange(50.0))
    values[[10, 11, 30]] = np.nan
    (path,) = plot_paths(_signal(values), ALL, ALL / 49.0)
    assert path.count("M") == 3
    assert len(_corners(path)) == 47
    assert plot_paths(_signal(np.full(50, np.nan)), ALL, ALL / 49.0) == ("",)


def test_long_curves_are_thinned_and_keep_their_peaks() -> None:
    values = np.zeros(20_000)
    values[7_777] = 1.0
    values[::2] += 0.001
    rows = np.arange(20_000)
    (path,) = plot_paths(_signal(values), rows, rows / 20_000.0)
    corners = _corners(path)
    assert len(corners) <= 500
    peak = corners[np.argmin(corners[:, 1])]
    assert abs(peak[0] - 388.85) < 5.0


def test_a_constant_has_a_flat_line_and_vectors_have_three() -> None:
    (path,) = plot_paths(_signal(np.full(50, 7.0)), ALL, ALL / 49.0)
    assert len(set(_corners(path)[:, 1])) == 1
    assert len(plot_paths(_signal(np.ones((50, 3))), ALL, ALL / 49.0)) == 3


def test_values_have_their_unit() -> None:
    signal = _signal(np.array([[1.0, -2.0, 0.5], [np.nan, 0.0, 0.0]]))
    assert value_text(signal, 0) == "1.00 -2.00 0.50 m/s"
    assert value_text(signal, 1) == "-"


def test_the_chart_marks_the_position_and_escapes_titles() -> None:
    chart = strip_chart([("<b>", ("M0 0L9 9",), "3 px")], 0.25, "<img src='data:'>")
    assert "M250.0 0V100" in chart
    assert "&lt;b&gt;" in chart
    assert "<b>" not in chart
    assert chart.count("<img") == 1


def test_images_keep_their_colours_and_shape() -> None:
    image = np.zeros((240, 640, 3), dtype=np.uint8)
    image[:, :, 0] = 200  # red
    code = re.search(r"base64,([^']+)", image_tag(image))
    assert code is not None
    data = np.frombuffer(base64.b64decode(code[1]), dtype=np.uint8)
    shown = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert shown.shape == (120, 320, 3)
    assert abs(int(shown[60, 160, 2]) - 200) < 6
    assert int(shown[60, 160, 0]) < 10
