from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import (
    descriptor_deviations,
    landmark_scores,
    mission_counts,
    sparsify,
)
from maplab_py.errors import FlagError, UserError
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.consistency import check_consistency
from maplab_py.vimap.merge import merge_maps
from tests.simulation.small import simulated as small_data
from tests.vimap.builders import walk_map


@pytest.fixture(scope="module")
def simulated() -> VIMap:
    vi_map = small_data().maps[0]
    quality = np.full(len(vi_map.landmarks), LandmarkQuality.GOOD)
    quality[::10] = LandmarkQuality.BAD
    return vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality))


@pytest.mark.parametrize("method", ["ilp", "greedy", "most_observed", "random"])
def test_exactly_so_many_good_landmarks_stay(simulated, method):
    result, report, coverage = sparsify(simulated, 150, SparsificationOptions(method=method))
    assert len(result.landmarks) == report.landmarks_after == 150
    assert np.all(result.landmarks.quality == LandmarkQuality.GOOD)
    assert check_consistency(result).errors == ()
    assert len(result.keypoints) == len(simulated.keypoints)
    counted = np.bincount(
        result.keypoint_vertex[result.observations], minlength=len(result.vertices)
    )
    assert np.all(coverage.after <= counted[coverage.vertex])
    assert report.below_wanted == np.count_nonzero(coverage.after < coverage.wanted)


def test_the_programme_covers_better_than_the_other_choices(simulated):
    objective = {
        method: sparsify(simulated, 120, SparsificationOptions(method=method))[1].objective
        for method in ("ilp", "greedy", "most_observed", "random")
    }
    assert max(objective, key=lambda method: objective[method]) == "ilp"


def test_the_report_names_keyframes_that_lack_landmarks(simulated):
    _, report, coverage = sparsify(simulated, 30, SparsificationOptions())
    worst = report.worst_keyframes[0]
    assert worst.before >= 30 > worst.after
    assert report.missions[0].keyframes == len(coverage.vertex)
    assert report.missions[0].below_wanted == report.below_wanted > 0


def test_with_enough_room_all_good_landmarks_stay(simulated):
    good = int((simulated.landmarks.quality == LandmarkQuality.GOOD).sum())
    result, report, _ = sparsify(simulated, good + 5, SparsificationOptions())
    assert len(result.landmarks) == good
    assert "all" in report.note


def test_nonsense_is_refused(simulated):
    with pytest.raises(UserError, match="num_landmarks_to_keep"):
        sparsify(simulated, 0, SparsificationOptions())
    bad = simulated.landmarks.replace(quality=np.full(len(simulated.landmarks), 1))
    with pytest.raises(UserError, match="good quality"):
        sparsify(simulated.replace(landmarks=bad), 10, SparsificationOptions())
    with pytest.raises(FlagError, match="method"):
        dataclasses.replace(SparsificationOptions(), method="best")


def test_deviation_is_the_mean_distance_from_the_majority():
    m = walk_map()
    rows = np.arange(len(m.landmarks))
    deviation = descriptor_deviations(m, rows)
    for row in (0, 7, 31):
        mine = m.observations[m.observation_start[row] : m.observation_start[row + 1]]
        bits = np.unpackbits(m.keypoints.descriptor[mine], axis=1)
        majority = bits.mean(axis=0) > 0.5
        assert deviation[row] == pytest.approx(np.mean(bits != majority))


def test_landmarks_of_several_missions_score_higher():
    one = walk_map()
    both, _ = merge_maps(one, walk_map(seed=1, first_ns=10**12))
    assert set(mission_counts(both)) <= {0, 1}
    shared = both.keypoints.landmark.copy()
    offset = len(one.landmarks)
    shared[shared == offset + 3] = 3  # landmark 3 is seen by the other mission too
    joined = both.replace(keypoints=both.keypoints.replace(landmark=shared))
    assert mission_counts(joined)[3] == 2
    rows = np.arange(len(joined.landmarks))
    before = landmark_scores(both, rows, threshold_bits=1e3)
    after = landmark_scores(joined, rows, threshold_bits=1e3)
    assert after[3] > before[3]
    assert after.max() <= 1.0
