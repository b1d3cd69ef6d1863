"""What is chosen, against brute force, the bound of the relaxation, and the simple choices."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from maplab_py.algorithms.sparsification.selection import (
    choose_greedily,
    choose_most_observed,
    choose_random,
    exchange,
    level_values,
    solve_exactly,
    solve_relaxed,
)
from maplab_py.algorithms.sparsification.sparsify import solve_by_parts, split
from tests.algorithms.sparsification.instances import corridor


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
    exact = solve_exactly(problem)
    assert exact.chosen.sum() == 4
    assert exact.objective == pytest.approx(best, rel=1e-3)
    relaxed = solve_relaxed(problem)
    assert relaxed.bound >= best - 1e-6
    assert relaxed.objective <= best + 1e-9
    assert choose_greedily(problem).sum() == 4


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("keep", [150, 400, 1200])
def test_rounding_loses_less_than_a_percent_and_beats_the_simple_choices(keep, weighted):
    problem = corridor(2000, 150, keep, weighted=weighted)
    relaxed = solve_relaxed(problem)
    assert relaxed.chosen.sum() == keep
    assert relaxed.objective >= 0.99 * relaxed.bound
    greedy = choose_greedily(problem)
    assert problem.objective(greedy) >= (1.0 - 1.0 / np.e) * relaxed.bound
    for other in (greedy, choose_most_observed(problem), choose_random(problem, 0)):
        assert other.sum() == keep
        assert problem.objective(other) <= relaxed.objective + 1e-6


def test_every_keyframe_gets_what_it_wants_when_that_is_possible():
    problem = corridor(4000, 300, 1600)
    solution = solve_relaxed(problem)
    assert np.all(problem.cover(solution.chosen) >= problem.wanted)
    assert np.any(problem.cover(choose_most_observed(problem)) < problem.wanted)


def test_parts_are_complete_and_nearly_as_good_as_the_whole():
    problem = corridor(3000, 200, 500)
    parts = split(problem, 800)
    assert len(parts) == 4
    np.testing.assert_array_equal(np.sort(np.concatenate(parts)), np.arange(3000))
    solution, count = solve_by_parts(problem, 800)
    assert count == 4
    assert solution.chosen.sum() == 500
    assert solution.objective >= problem.objective(choose_greedily(problem))
    assert solution.objective >= 0.995 * solve_relaxed(problem).bound


def test_an_exchange_only_improves():
    problem = corridor(600, 60, 100)
    start = choose_random(problem, 3)
    better = exchange(problem, start)
    assert better.sum() == 100
    assert problem.objective(better) > problem.objective(start)


def test_a_restricted_problem_counts_what_the_others_cover():
    problem = corridor(200, 30, 60)
    chosen = choose_random(problem, 1)
    rows = np.arange(40, 120)
    inner = problem.restricted(rows, chosen)
    assert inner.keep == chosen[rows].sum()
    other = chosen.copy()
    other[rows] = choose_random(inner, 5)
    change = problem.objective(other) - problem.objective(chosen)
    assert inner.objective(other[rows]) - inner.objective(chosen[rows]) == pytest.approx(change)


def test_prices_double_from_part_to_part():
    assert level_values(3).tolist() == [4.0, 2.0, 1.0]
    problem = corridor(50, 10, 5, wanted=6, levels=3)
    worth = problem.value(np.array([0.0, 1.0, 2.0, 3.0, 6.0, 9.0]), np.full(6, 6.0))
    assert worth.tolist() == [0.0, 4.0, 8.0, 10.0, 14.0, 14.0]


def test_the_same_problem_gets_the_same_choice():
    first, second = (solve_relaxed(corridor(1500, 100, 300)) for _ in range(2))
    np.testing.assert_array_equal(first.chosen, second.chosen)
