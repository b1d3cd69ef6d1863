"""Choice of the landmarks that stay: coverage, greedy choice, integer programme."""

from __future__ import annotations

import dataclasses
import heapq
from functools import cached_property
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.errors import EstimationError
from maplab_py.vimap.table import starts_of_counts

# Landmark selection as a coverage problem.
#
# Schneider 2019, eq. 4.2, with the score maximised and one slack per keyframe: select exactly n
# landmarks with a high sum of scores such that every keyframe observes the wanted number of them.
# There are two extensions. Landmarks are weighted by the probability of being matched again. The value
# of the coverage of a keyframe decreases in levels, so that ten keyframes which lack one landmark each
# are better than one keyframe that lacks ten.


_TINY = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class CoverageProblem:
    """K keyframes, L landmarks, their covisibility, and the wanted coverage."""

    keyframe: (
        I64  # (N,) with `landmark`: pairs of a keyframe and an observed landmark, each pair once
    )
    landmark: I64  # (N,)
    score: F64  # (L,) in [0, 1]
    weight: (
        F64  # (L,) in (0, 1], contribution of a landmark to the cover of keyframes that observe it
    )
    wanted: F64  # (K,) wanted cover of each keyframe, at most the possible cover
    base: F64  # (K,) cover of each keyframe by fixed landmarks
    level_value: F64  # (S,) decreasing value of a unit of cover in S equal parts of `full`
    full: float  # cover at which the last part ends
    keep: int  # landmarks to choose

    @property
    def landmarks(self) -> int:
        """Number of landmarks."""
        return len(self.score)

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.wanted)

    @cached_property
    def seen(self) -> Any:
        """Sparse matrix (K, L) with ones where a keyframe observes a landmark."""
        from scipy.sparse import csr_array

        ones = np.ones(len(self.landmark))
        shape = (self.keyframes, self.landmarks)
        return csr_array((ones, (self.keyframe, self.landmark)), shape=shape)

    @cached_property
    def seers(self) -> tuple[I64, I64]:
        """Offsets (L + 1) and keyframes, by landmark."""
        order = np.argsort(self.landmark, kind="stable")
        counts = np.bincount(self.landmark, minlength=self.landmarks)
        return starts_of_counts(counts), self.keyframe[order]

    def cover(self, chosen: Mask) -> F64:
        """Return the cover (K,) of the keyframes by a selection (L,)."""
        mine = chosen[self.landmark]
        added = np.bincount(
            self.keyframe[mine], self.weight[self.landmark[mine]], minlength=self.keyframes
        )
        return np.asarray(self.base + added)

    def value(self, cover: F64, wanted: F64) -> F64:
        """Return the values (N,) of covers (N,) of keyframes with wanted cover (N,)."""
        edges = np.linspace(0.0, self.full, len(self.level_value) + 1)
        worth = np.concatenate([[0.0], np.cumsum(self.level_value * np.diff(edges))])
        return np.asarray(np.interp(np.minimum(cover, wanted), edges, worth))

    def objective(self, chosen: Mask) -> float:
        """Return the sum of score and coverage value of a selection (L,)."""
        gained = self.value(self.cover(chosen), self.wanted) - self.value(self.base, self.wanted)
        return float(self.score[chosen].sum() + gained.sum())

    def gain_of_more(self, cover: F64) -> F64:
        """Return the value (K,) of the next unit of cover."""
        return np.where(cover < self.wanted - _TINY, self._value_at(cover + _TINY), 0.0)

    def loss_of_less(self, cover: F64) -> F64:
        """Return the value (K,) of the last unit of cover."""
        return np.where(cover <= self.wanted + _TINY, self._value_at(cover - _TINY), 0.0)

    def _value_at(self, cover: F64) -> F64:
        part = np.floor(cover * len(self.level_value) / max(self.full, _TINY)).astype(np.int64)
        return np.append(self.level_value, 0.0)[np.clip(part, 0, len(self.level_value))]

    def restricted(self, landmarks: I64, chosen: Mask) -> CoverageProblem:
        """Return the subproblem of selecting among some landmarks while the others are fixed.

        Args:
            landmarks: Rows (P,), sorted.
            chosen: The current selection (L,); the subproblem selects the same number of the rows.
        """
        inside = mask_of(self.landmarks, landmarks)
        row = np.cumsum(inside) - 1
        pairs = np.flatnonzero(inside[self.landmark])
        keyframes, keyframe = np.unique(self.keyframe[pairs], return_inverse=True)
        return CoverageProblem(
            keyframe=keyframe.reshape(-1),
            landmark=row[self.landmark[pairs]],
            score=self.score[landmarks],
            weight=self.weight[landmarks],
            wanted=self.wanted[keyframes],
            base=self.cover(chosen & ~inside)[keyframes],
            level_value=self.level_value,
            full=self.full,
            keep=int(chosen[landmarks].sum()),
        )


def level_values(levels: int) -> F64:
    """Return the value (levels,) of cover per level: ..., 4, 2, 1.

    The lowest value is 1, the highest score of a landmark: no score outweighs a landmark that a
    keyframe lacks.
    """
    return np.asarray(2.0 ** np.arange(levels - 1, -1, -1), dtype=np.float64)


def choose_random(problem: CoverageProblem, seed: int) -> Mask:
    """Select landmarks at random."""
    rows = np.random.default_rng(seed).permutation(problem.landmarks)[: problem.keep]
    return mask_of(problem.landmarks, rows)


def choose_most_observed(problem: CoverageProblem) -> Mask:
    """Select the landmarks that most keyframes observe; the score breaks ties."""
    seers = np.bincount(problem.landmark, minlength=problem.landmarks)
    return mask_of(problem.landmarks, np.lexsort((-problem.score, -seers))[: problem.keep])


def choose_greedily(problem: CoverageProblem, start: Mask | None = None) -> Mask:
    """Select landmarks greedily by their gain in the objective.

    The objective is submodular: the gain of a landmark decreases when others are selected. A gain
    computed earlier is therefore an upper bound, and only the best bounds are evaluated again
    (lazy evaluation: Minoux 1978). The result has at least 1 - 1/e of the optimal objective
    (Nemhauser et al. 1978).

    Args:
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


# Integer programme of sparsification, solved with HiGHS: exactly, or relaxed and rounded.
#
# Variables: x (L,) in {0, 1}, whether a landmark is kept; u (K, S) >= 0, the cover of a keyframe at
# each of S levels. Maximise score^T x + sum of level_value u, subject to sum x = keep and
# sum_s u_ks <= (A x)_k, where A holds the weight of a landmark in the rows of keyframes that observe
# it. Level values decrease, so the most valuable level fills first. The difference of u to the wanted
# cover is the slack of Schneider 2019, eq. 4.2.


_GAP = 1e-4
"""Relative gap at which the exact search stops."""
_MAX_NODES = 200
"""Maximum number of nodes of the exact search; unlike a time limit, it is deterministic."""
_INTEGRAL = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """A selection and its objective."""

    chosen: Mask  # (L,)
    objective: float
    bound: float  # upper bound on the objective


def solve_exactly(problem: CoverageProblem) -> Solution:
    """Solve the integer programme by branch and bound, to a relative gap of 1e-4.

    Raises:
        EstimationError: HiGHS gives up.
    """
    from scipy.optimize import Bounds, LinearConstraint, milp

    p = _programme(problem)
    integral = np.zeros(len(p.cost))
    integral[: problem.landmarks] = 1
    result = milp(
        p.cost,
        integrality=integral,
        bounds=Bounds(np.zeros(len(p.cost)), p.upper),
        constraints=[
            LinearConstraint(p.rows, -np.inf, 0.0),
            LinearConstraint(p.count, problem.keep, problem.keep),
        ],
        options={"mip_rel_gap": _GAP, "node_limit": _MAX_NODES},
    )
    if result.x is None:
        return solve_relaxed(problem)
    chosen = result.x[: problem.landmarks] > 0.5
    return Solution(chosen, problem.objective(chosen), float(-result.mip_dual_bound))


def solve_relaxed(problem: CoverageProblem) -> Solution:
    """Solve the linear relaxation, keep landmarks with x = 1, fill up greedily and exchange.

    A vertex of the relaxation has at most K + 1 fractional x, few in practice, so that the loss by
    rounding is small; the bound measures it.

    Raises:
        EstimationError: HiGHS gives up.
    """
    from scipy.optimize import linprog

    p = _programme(problem)
    bounds = np.stack([np.zeros(len(p.cost)), p.upper], axis=1)
    result = linprog(
        p.cost,
        A_ub=p.rows,
        b_ub=np.zeros(p.rows.shape[0]),
        A_eq=p.count,
        b_eq=[problem.keep],
        bounds=bounds,
        method="highs-ds",
    )
    if result.x is None:
        raise EstimationError(f"landmarks cannot be chosen: {result.message}")
    whole = result.x[: problem.landmarks] > 1.0 - _INTEGRAL
    chosen = exchange(problem, choose_greedily(problem, whole))
    return Solution(chosen, problem.objective(chosen), float(-result.fun))


@dataclasses.dataclass(frozen=True, eq=False)
class _Programme:
    cost: F64  # (L + U,)
    upper: F64  # (L + U,)
    rows: Any  # (K, L + U), each at most 0
    count: Any  # (1, L + U)


def _programme(problem: CoverageProblem) -> _Programme:
    from scipy.sparse import csr_array, dia_array, hstack

    landmarks, keyframes = problem.landmarks, problem.keyframes
    edges = np.linspace(0.0, problem.full, len(problem.level_value) + 1)
    low = np.maximum(edges[None, :-1], problem.base[:, None])
    width = np.minimum(edges[None, 1:], problem.wanted[:, None]) - low
    keyframe, level = np.nonzero(width > 0.0)
    useful = len(keyframe)
    ones = csr_array((np.ones(useful), (keyframe, np.arange(useful))), shape=(keyframes, useful))
    weights = dia_array((problem.weight[None], [0]), shape=(landmarks, landmarks))
    count = np.concatenate([np.ones(landmarks), np.zeros(useful)])
    return _Programme(
        cost=np.concatenate([-problem.score, -problem.level_value[level]]),
        upper=np.concatenate([np.ones(landmarks), width[keyframe, level]]),
        rows=hstack([-(problem.seen @ weights), ones]).tocsc(),
        count=csr_array(count[None]),
    )
