"""Choices without an integer programme: greedy cover, exchange of single landmarks, baselines."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.sparsification.coverage import CoverageProblem

Mask = NDArray[np.bool_]
I64 = NDArray[np.int64]

_TINY = 1e-9


def choose_random(problem: CoverageProblem, seed: int) -> Mask:
    """Choose at random."""
    rows = np.random.default_rng(seed).permutation(problem.landmarks)[: problem.keep]
    return _mask(problem, rows)


def choose_most_observed(problem: CoverageProblem) -> Mask:
    """Choose what most keyframes see; the higher score decides between equals."""
    seers = np.bincount(problem.landmark, minlength=problem.landmarks)
    return _mask(problem, np.lexsort((-problem.score, -seers))[: problem.keep])


def choose_greedily(problem: CoverageProblem, start: Mask | None = None) -> Mask:
    """Choose one after the other what adds most to the objective.

    The objective is submodular: a landmark's gain only falls while others are chosen. So a gain
    computed earlier is a bound, and only the best bounds need a fresh look (lazy evaluation:
    Minoux 1978). The result is worth at least 1 - 1/e of the best choice (Nemhauser et al. 1978).

    Args:
        problem: The problem.
        start: Landmarks (L,) that are chosen already, at most as many as are to be kept.
    """
    chosen = np.zeros(problem.landmarks, dtype=np.bool_) if start is None else start.copy()
    missing = problem.keep - int(chosen.sum())
    offset, keyframe = problem.seers
    cover = problem.cover(chosen)
    value = problem.value(cover, problem.wanted)
    # the price of the next bit of cover bounds the value of a whole landmark
    bound = problem.score + problem.weight * (problem.seen.T @ problem.price_of_more(cover))
    free = np.flatnonzero(~chosen)
    heap = list(zip((-bound[free]).tolist(), free.tolist(), strict=True))
    heapq.heapify(heap)
    while missing > 0 and heap:
        best, row = heap[0]
        mine = keyframe[offset[row] : offset[row + 1]]
        after = problem.value(cover[mine] + problem.weight[row], problem.wanted[mine])
        gain = -float(problem.score[row] + (after - value[mine]).sum())
        if gain > best + _TINY:
            heapq.heapreplace(heap, (gain, row))
            continue
        heapq.heappop(heap)
        chosen[row] = True
        missing -= 1
        cover[mine] += problem.weight[row]
        value[mine] = after
    return chosen


def exchange(problem: CoverageProblem, chosen: Mask, *, most: int = 2000) -> Mask:
    """Swap a chosen landmark for another as long as the objective rises by it.

    Args:
        problem: The problem.
        chosen: A choice (L,).
        most: Swaps to make at most.
    """
    chosen = chosen.copy()
    offset, keyframe = problem.seers
    seen = problem.seen.T.tocsr()
    cover, objective = problem.cover(chosen), problem.objective(chosen)
    for _ in range(most):
        if not chosen.any() or chosen.all():
            break
        gain = problem.score + problem.weight * (seen @ problem.price_of_more(cover))
        add = int(np.argmax(np.where(chosen, -np.inf, gain)))
        cover[keyframe[offset[add] : offset[add + 1]]] += problem.weight[add]
        loss = problem.score + problem.weight * (seen @ problem.price_of_less(cover))
        drop = int(np.argmin(np.where(chosen, loss, np.inf)))
        chosen[add], chosen[drop] = True, False
        now = problem.objective(chosen)
        if now <= objective + _TINY:
            chosen[add], chosen[drop] = False, True
            break
        cover[keyframe[offset[drop] : offset[drop + 1]]] -= problem.weight[drop]
        objective = now
    return chosen


def _mask(problem: CoverageProblem, rows: I64) -> Mask:
    chosen = np.zeros(problem.landmarks, dtype=np.bool_)
    chosen[rows] = True
    return chosen
