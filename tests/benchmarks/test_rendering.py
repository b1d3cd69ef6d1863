"""The benchmark of rendering lives: equal grey values in a fraction of the time."""

from __future__ import annotations

import pytest

from tests.benchmarks.rendering import measure


@pytest.mark.slow
def test_equal_grey_values_in_a_tenth_of_the_time() -> None:
    figures = measure(images=6)
    assert figures.largest_grey_difference <= 0.02
    assert figures.ratio >= 10.0
