"""Precision and recall of closures between simulated sessions, with noisy descriptors."""

from __future__ import annotations

import pytest

from maplab_py.algorithms.loop_closure.workflow import search_loops
from tests.algorithms.loop_closure.against_truth import score, sessions

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("flips", "vanish", "precision", "recall"), [(0.05, 0.0, 0.995, 0.90), (0.15, 0.3, 0.99, 0.60)]
)
def test_closures_of_four_sessions(flips, vanish, precision, recall):
    vi_map, truth = sessions(flips, vanish, seed=1, rate_hz=3.0, duration_s=40.0)
    search, _ = search_loops(vi_map)
    result = score(vi_map, truth, search.closures)
    assert result.closable > 300
    assert result.accepted > 300
    assert result.precision >= precision
    assert result.recall >= recall
