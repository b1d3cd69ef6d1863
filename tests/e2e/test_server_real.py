"""The server with real processes and maps: killed again and again, and as accurate as promised."""

import pytest

from benchmarks.server.euroc import measure_euroc
from benchmarks.server.kills import measure_kills

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("robots", [1, 2])
def test_euroc_submaps_of_one_robot_and_of_two(robots: int) -> None:
    figures = measure_euroc(robots)
    assert figures.missions == figures.anchored == robots
    assert figures.incremental_O_m <= 0.042
    assert figures.incremental_C_m <= 0.026
    assert figures.final_O_m <= 0.042
    assert figures.final_C_m <= 0.026


def test_every_submap_is_in_the_map_once_after_kills() -> None:
    figures = measure_kills(kills=4, submaps_each=4)
    assert figures.submaps == 16
    assert figures.missing_vertices == figures.repeated_vertices == figures.rejected == 0
    assert figures.ratio <= 1.1
