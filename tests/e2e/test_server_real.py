"""EuRoC's eight submaps through the server's merging, held to the accuracy that the project promises."""

from __future__ import annotations

import pytest

from benchmarks.server.euroc import measure_euroc

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("robots", [1, 2])
def test_euroc_submaps_of_one_robot_and_of_two(robots: int) -> None:
    figures = measure_euroc(robots)
    assert figures.missions == figures.anchored == robots
    assert figures.incremental_O_m <= 0.042
    assert figures.incremental_C_m <= 0.026
    assert figures.final_O_m <= 0.042
    assert figures.final_C_m <= 0.026
