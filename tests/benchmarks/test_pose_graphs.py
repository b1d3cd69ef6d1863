"""Pose graphs as fast as docs/benchmarks.md says, with room for machines that do other work."""

from __future__ import annotations

import pytest

from benchmarks.pose_graphs import compare_graph
from tests.support.data import shared_data


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("parking-garage", 0.8),
        ("smallGrid3D", 0.8),
        ("robot_a", 0.8),
        ("robot_b", 0.8),
        ("ordered", 1.5),  # 6 ms: as fast as the peer, not faster; this only keeps it there
    ],
)
def test_equal_objective_in_about_the_time_of_the_page(name: str, most: float) -> None:
    pytest.importorskip("gtsam", reason="a peer of the extra [bench] is not there")
    shared_data(f"g2o/{name}.g2o")
    comparison = compare_graph(name, repeats=5)
    assert abs(comparison.difference) <= 1e-6
    assert comparison.ratio <= most
