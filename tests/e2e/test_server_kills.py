"""A server that is killed again and again, with real processes."""

from __future__ import annotations

import pytest

from benchmarks.server.kills import measure_kills

pytestmark = pytest.mark.slow


def test_every_submap_is_in_the_map_once_after_kills() -> None:
    figures = measure_kills(kills=5)
    assert figures.submaps == 40
    assert figures.missing_vertices == figures.repeated_vertices == figures.rejected == 0
    assert figures.ratio <= 1.1
