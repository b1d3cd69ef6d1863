"""The benchmark of rendering lives: equal grey values in a fraction of the time."""

from __future__ import annotations

import pytest

from benchmarks.rendering import CROWDED, measure


@pytest.mark.slow
def test_equal_grey_values_in_a_tenth_of_the_time() -> None:
    figures = measure(images=6)
    assert figures.largest_grey_difference <= 0.02
    assert figures.ratio >= 10.0


@pytest.mark.slow
def test_many_boxes_hardly_take_longer() -> None:
    # numpy tests every ray against every box: about thirteen times as long with a hundred more
    figures = measure(images=3, boxes=CROWDED, compared=1)
    assert figures.largest_grey_difference <= 0.02
    assert figures.ratio >= 200.0
