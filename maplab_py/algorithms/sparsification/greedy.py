"""Selection without integer programme: greedy cover, exchange of landmarks, baselines."""

from __future__ import annotations

import heapq

import numpy as np

from maplab_py.algorithms.sparsification.coverage import CoverageProblem
from maplab_py.array_types import I64, Mask

_TINY = 1e-9


def choose_random(problem: CoverageProblem, seed: int) -> Mask:
    """Select landmarks at random."""
    rows = np.random.default_rng(seed).permutation(problem.landmarks)[: problem.keep]
    return _mask(problem, rows)


def choose_most_observed(problem: CoverageProblem) -> Mask:
    """Select the landmarks that most keyframes observe; the score breaks ties."""
    seers = np.bincount(problem.landmark, minlength=problem.landmarks)
    return _mask(problem, np.lexsort((-problem.score, -seers))[: problem.keep])


def choose_greedily(problem: CoverageProblem, start: Mask | None = None) -> Mask:
    """Select landmarks greedily by their gain in the objective.

    The objective is submodular: the gain of a landmark decreases when others are selected. A gain
    computed earlier is therefore an upper bound, and only the best bounds are evaluated again
    (lazy evaluation: Minoux 1978). The result has at least 1 - 1/e of the optimal objective
    (Nemhauser et al. 1978).

    Args:
        problem: The problem.
        start: Mask (L,) of landmarks selected already, at most as many as are kept.
    """
    chosen = np.zeros(problem.landmarks, dtype=np.bool_) if start is None else start.copy()
    missing = problem.keep - int(chosen.sum())
    offset, keyframe = problem.seers
    cover = problem.cover(chosen)
    value = problem.value(cover, problem.wanted)
    # the value of the next unit of cover bounds the gain of a landmark
    bound = problem.score + problem.weight * (problem.seen.T @ problem.gain_of_more(cover))
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
    """Swap selected landmarks for others as long as the objective increases.

    Args:
        problem: The problem.
        chosen: A selection (L,).
        most: Maximum number of swaps.
    """
    chosen = chosen.copy()
    offset, keyframe = problem.seers
    seen = problem.seen.T.tocsr()
    cover, objective = problem.cover(chosen), problem.objective(chosen)
    for _ in range(most):
        if not chosen.any() or chosen.all():
            break
        gain = problem.score + problem.weight * (seen @ problem.gain_of_more(cover))
        add = int(np.argmax(np.where(chosen, -np.inf, gain)))
        cover[keyframe[offset[add] : offset[add + 1]]] += problem.weight[add]
        loss = problem.score + problem.weight * (seen @ problem.loss_of_less(cover))
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
