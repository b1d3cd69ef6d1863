"""The coverage problem that is made of a map: weights, and what a keyframe can want at most."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import coverage_problem, sparsify
from maplab_py.vimap import VIMap
from maplab_py.vimap.queries import observer_counts
from tests.vimap.builders import walk_map

# without noise every descriptor of a landmark is stable: the weight depends on the observers only
STABLE = {"descriptor_dev_scoring_threshold": 1e6}


@pytest.fixture(scope="module")
def vi_map() -> VIMap:
    return walk_map()


def problem_of(vi_map: VIMap, **options):
    rows = np.arange(len(vi_map.landmarks))
    return coverage_problem(vi_map, rows, 20, SparsificationOptions(**STABLE, **options))[0]


def test_weights_count_only_where_they_are_asked_for(vi_map: VIMap) -> None:
    plain, weighted = problem_of(vi_map), problem_of(vi_map, weighted=True)
    assert np.all(plain.weight == 1.0)
    seen = np.maximum(observer_counts(vi_map), 1)
    np.testing.assert_allclose(weighted.weight, 1.0 - 0.7**seen)
    assert len(np.unique(weighted.weight)) == 3


@pytest.mark.parametrize("weighted", [False, True])
def test_a_keyframe_wants_no_more_than_it_can_have(vi_map: VIMap, weighted: bool) -> None:
    plenty = problem_of(vi_map, weighted=weighted, min_keypoints_per_keyframe=10_000)
    everything = plenty.cover(np.ones(plenty.landmarks, dtype=bool))
    np.testing.assert_allclose(plenty.wanted, everything)
    few = problem_of(vi_map, weighted=weighted, min_keypoints_per_keyframe=3)
    assert np.all(few.wanted <= 3.0)
    assert few.wanted.max() == 3.0


def test_the_report_does_not_miss_what_was_never_there(vi_map: VIMap) -> None:
    keep = len(vi_map.landmarks)
    plenty = SparsificationOptions(min_keypoints_per_keyframe=10_000)
    _, report, coverage = sparsify(vi_map, keep, plenty)
    assert report.landmarks_after == report.landmarks_before
    assert report.below_wanted == 0
    np.testing.assert_array_equal(coverage.wanted, coverage.before)
