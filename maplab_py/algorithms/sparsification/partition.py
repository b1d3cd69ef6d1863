"""Partition large coverage problems and improve a selection part by part."""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.sparsification.coverage import CoverageProblem
from maplab_py.algorithms.sparsification.greedy import choose_greedily
from maplab_py.algorithms.sparsification.integer_programme import Solution, solve_relaxed
from maplab_py.array_types import I64
from maplab_py.progress import SILENT, Progress


def solve_by_parts(
    problem: CoverageProblem, landmarks_per_part: int, *, progress: Progress = SILENT
) -> tuple[Solution, int]:
    """Select greedily over the whole map, then optimise each part while the others are fixed.

    The greedy selection determines the number of landmarks of each part and the cover of border
    keyframes by neighbouring parts. The objective never decreases.

    Returns:
        The solution, whose bound is not known (NaN), and the number of parts.
    """
    chosen = choose_greedily(problem)
    parts = split(problem, landmarks_per_part)
    for number, rows in enumerate(parts):
        progress.step(number, len(parts), "parts of the map")
        inner = problem.restricted(rows, chosen)
        if inner.keep in (0, inner.landmarks):
            continue
        better = solve_relaxed(inner)
        if better.objective > inner.objective(chosen[rows]):
            chosen[rows] = better.chosen
    return Solution(chosen, problem.objective(chosen), float("nan")), len(parts)


def split(problem: CoverageProblem, landmarks_per_part: int) -> list[I64]:
    """Return landmark rows of parts of nearly equal size, along the co-visibility graph.

    Keyframes are ordered such that co-visible ones are close (reverse Cuthill and McKee 1969, which
    reduces the bandwidth of the matrix). Landmarks are ordered by their median keyframe.
    """
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    shared = (problem.seen @ problem.seen.T).tocsr()
    place = np.empty(problem.keyframes, dtype=np.int64)
    place[reverse_cuthill_mckee(shared, symmetric_mode=True)] = np.arange(problem.keyframes)
    order = np.lexsort((place[problem.keyframe], problem.landmark))
    offset, _ = problem.seers
    middle = np.zeros(problem.landmarks, dtype=np.int64)
    seen = np.diff(offset) > 0
    median = order[(offset[:-1] + np.diff(offset) // 2)[seen]]
    middle[seen] = place[problem.keyframe[median]]
    ordered = np.argsort(middle, kind="stable")
    parts = -(-problem.landmarks // landmarks_per_part)
    return [np.sort(rows) for rows in np.array_split(ordered, parts)]
