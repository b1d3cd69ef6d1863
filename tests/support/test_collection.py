"""What pytest collects: tests only, not what they test."""

from __future__ import annotations

import pytest

from maplab_py.algorithms.self_calibration.pruning import test_mutual_consistency, test_segments


def test_functions_of_the_product_are_not_collected(request: pytest.FixtureRequest) -> None:
    collected = {item.name for item in request.session.items if item.path == request.path}
    assert request.node.name in collected
    assert not collected & {test_segments.__name__, test_mutual_consistency.__name__}
