"""Pose graphs as fast as docs/benchmarks.md says, with room for machines that do other work."""

from __future__ import annotations

import pytest

from tests.benchmarks.pose_graphs import compare_graph
from tests.support.data import shared_data


@pytest.mark.slow
@pytest.mark.parametrize("name", ["parking-garage", "smallGrid3D", "robot_a", "robot_b", "ordered"])
def test_equal_objective_in_less_time(name: str) -> None:
    pytest.importorskip("gtsam", reason="a peer of the extra [bench] is not there")
    shared_data(f"g2o/{name}.g2o")
    comparison = compare_graph(name, repeats=5)
    assert abs(comparison.difference) <= 1e-6
    assert comparison.ratio <= 0.8
