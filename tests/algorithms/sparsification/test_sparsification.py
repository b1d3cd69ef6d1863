"""Landmarks that are kept: problem of a map, choices against brute force and bound, the command's work."""

import dataclasses
import itertools

import numpy as np
import pytest

from maplab_py.algorithms.sparsification import selection
from maplab_py.algorithms.sparsification.options import SparsificationOptions
from maplab_py.algorithms.sparsification.sparsify import (
    coverage_problem,
    descriptor_deviations,
    landmark_scores,
    mission_counts,
    solve_by_parts,
    sparsify,
    split,
)
from maplab_py.errors import FlagError, UserError
from maplab_py.vimap import LandmarkQuality, VIMap, consistency, merge, observer_counts
from tests.algorithms.sparsification.instances import corridor
from tests.simulation.small import simulated as small_data
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


def best_of_all(problem):
    best = -np.inf
    for rows in itertools.combinations(range(problem.landmarks), problem.keep):
        chosen = np.zeros(problem.landmarks, dtype=bool)
        chosen[list(rows)] = True
        best = max(best, problem.objective(chosen))
    return best


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("levels", "weighted"), [(1, False), (2, False), (3, False), (3, True)])
def test_the_exact_choice_is_the_best_of_all(seed, levels, weighted):
    problem = corridor(12, 8, 4, wanted=3, levels=levels, weighted=weighted, seed=seed)
    best = best_of_all(problem)
    exact = selection.solve_exactly(problem)
    assert exact.chosen.sum() == 4
    assert exact.objective == pytest.approx(best, rel=1e-3)
    relaxed = selection.solve_relaxed(problem)
    assert relaxed.bound >= best - 1e-6
    assert relaxed.objective <= best + 1e-9
    assert selection.choose_greedily(problem).sum() == 4


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("keep", [150, 400, 1200])
def test_rounding_loses_less_than_a_percent_and_beats_the_simple_choices(keep, weighted):
    problem = corridor(2000, 150, keep, weighted=weighted)
    relaxed = selection.solve_relaxed(problem)
    assert relaxed.chosen.sum() == keep
    assert relaxed.objective >= 0.99 * relaxed.bound
    greedy = selection.choose_greedily(problem)
    assert problem.objective(greedy) >= (1.0 - 1.0 / np.e) * relaxed.bound
    for other in (
        greedy,
        selection.choose_most_observed(problem),
        selection.choose_random(problem, 0),
    ):
        assert other.sum() == keep
        assert problem.objective(other) <= relaxed.objective + 1e-6


def test_every_keyframe_gets_what_it_wants_when_that_is_possible():
    problem = corridor(4000, 300, 1600)
    solution = selection.solve_relaxed(problem)
    assert np.all(problem.cover(solution.chosen) >= problem.wanted)
    assert np.any(problem.cover(selection.choose_most_observed(problem)) < problem.wanted)


def test_parts_are_complete_and_nearly_as_good_as_the_whole():
    problem = corridor(3000, 200, 500)
    parts = split(problem, 800)
    assert len(parts) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(3000))
    solution, count = solve_by_parts(problem, 800)
    assert count == 4
    assert solution.chosen.sum() == 500
    assert solution.objective >= problem.objective(selection.choose_greedily(problem))
    assert solution.objective >= 0.995 * selection.solve_relaxed(problem).bound


def test_an_exchange_only_improves():
    problem = corridor(600, 60, 100)
    start = selection.choose_random(problem, 3)
    better = selection.exchange(problem, start)
    assert better.sum() == 100
    assert problem.objective(better) > problem.objective(start)


def test_a_restricted_problem_counts_what_the_others_cover():
    problem = corridor(200, 30, 60)
    chosen = selection.choose_random(problem, 1)
    rows = np.arange(40, 120)
    inner = problem.restricted(rows, chosen)
    assert inner.keep == chosen[rows].sum()
    other = chosen.copy()
    other[rows] = selection.choose_random(inner, 5)
    change = problem.objective(other) - problem.objective(chosen)
    assert inner.objective(other[rows]) - inner.objective(chosen[rows]) == pytest.approx(change)


def test_prices_double_from_part_to_part():
    assert selection.level_values(3).tolist() == [4.0, 2.0, 1.0]
    problem = corridor(50, 10, 5, wanted=6, levels=3)
    worth = problem.value(np.array([0.0, 1.0, 2.0, 3.0, 6.0, 9.0]), np.full(6, 6.0))
    assert worth.tolist() == [0.0, 4.0, 8.0, 10.0, 14.0, 14.0]


def test_the_same_problem_gets_the_same_choice():
    first, second = (selection.solve_relaxed(corridor(1500, 100, 300)) for _ in range(2))
    np.testing.assert_array_equal(first.chosen, second.chosen)


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
    assert consistency.check_consistency(result).errors == ()
    assert len(result.keypoints) == len(simulated.keypoints)
    counted = np.bincount(
        result.keypoint_vertex[result.observations], minlength=len(result.vertices)
    )
    assert np.all(coverage.after <= counted[coverage.vertex])
    assert report.below_wanted == np.count_nonzero(coverage.after < coverage.wanted)


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
    both, _ = merge.merge_maps(one, walk_map(seed=1, first_ns=10**12))
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
