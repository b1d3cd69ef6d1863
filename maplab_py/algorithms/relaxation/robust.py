"""The robust optimisation of a pose graph: ever stricter losses, then a verdict on every closure.

Far from the answer a true closure looks as false as a false one. So a loss begins where most closures
count and becomes stricter step by step (graduated non-convexity: Yang et al., RA-L 2020).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation.losses import LOSSES
from maplab_py.algorithms.relaxation.optimizer import PoseGraphOptimizer
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors
from maplab_py.algorithms.relaxation.verdict import (
    independent_errors,
    variance_factor,
    with_tail,
)
from maplab_py.progress import Progress

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_PRICE_RATIO = 4.0  # from one stage to the next
_STAGE_ITERATIONS = 4
_STARTS = (1.0, 0.5)
"""Shares of the closures that count in the beginning. All of them: right where drift is large. Half
of them: right where false ones would turn the graph inside out."""
_TRUSTED = 0.5  # weight
_VERDICTS = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """Poses of all vertices and what became of the loop closures."""

    T_G_I: F64  # (V, 7)
    weight: F64  # (E,) of every closure, 1 = trusted, 0 = switched off
    iterations: int
    cost_before: float
    cost_after: float


def optimize_robustly(
    T_G_I: F64,
    is_free: NDArray[np.bool_],
    trajectory: RelativePoses,
    loops: RelativePoses,
    tilt: TiltPriors,
    options: RelaxationOptions,
    progress: Progress,
) -> Solution:
    """Optimise vertex poses.

    Args:
        T_G_I: Poses (V, 7) to begin with.
        is_free: Vertices (V,) that may move.
        trajectory: Edges along missions, not robust.
        loops: Loop closures.
        tilt: Priors of roll and pitch.
        options: Robustness and iterations.
        progress: Shows iterations and cancels.

    Raises:
        EstimationError: The poses are not determined, or not finite.
    """
    graph = _Graph(T_G_I, is_free, trajectory, loops, tilt, options, progress)
    if options.robustness == "gnc":
        return graph.consistent()
    if options.robustness == "none":
        return graph.plain()
    return graph.annealed()


class _Graph:
    """What all ways of optimising a graph need."""

    def __init__(
        self,
        T_G_I: F64,
        is_free: NDArray[np.bool_],
        trajectory: RelativePoses,
        loops: RelativePoses,
        tilt: TiltPriors,
        options: RelaxationOptions,
        progress: Progress,
    ) -> None:
        self.T_G_I = T_G_I
        self.loops = loops
        self.options = options
        self.progress = progress
        name = "dcs" if options.robustness == "gnc" else options.robustness
        self.loss = LOSSES[name]
        self.optimizer = PoseGraphOptimizer(is_free, trajectory, loops, tilt, name)

    def plain(self) -> Solution:
        T, iterations = self._finish(self.optimizer, self.T_G_I, 1.0)
        return self._solution(T, np.ones(len(self.loops)), iterations, 1.0)

    def annealed(self) -> Solution:
        """Lower the price of switching off to the one asked for; of all starts the least cost wins."""
        price = self.options.switch_prior
        solutions: list[Solution] = []
        for share in _STARTS:
            T, iterations = self._anneal(share, price)
            T, more = self._finish(self.optimizer, T, price)
            weight = self.loss(self.loops.squared_errors(T), price)[1]
            solutions.append(self._solution(T, weight, iterations + more, price))
            if np.all(weight > _TRUSTED):
                break
        return _best(solutions, [s.cost_after for s in solutions])

    def consistent(self) -> Solution:
        """Find the closures that agree, and trust those fully and the others not at all.

        Begins in several ways, if the first does not trust all. The least truncated cost wins: what
        the trusted ones cost, and the limit for each of the others.
        """
        solutions: list[Solution] = []
        limits: list[float] = []
        for share in _STARTS:
            T, iterations = self._anneal(share, self.options.switch_prior)
            solution, limit = self._judged(T, iterations)
            solutions.append(solution)
            limits.append(limit)
            if np.all(solution.weight == 1.0):
                break
        off = max(limits)
        return _best(solutions, [s.cost_after + off * np.sum(1.0 - s.weight) for s in solutions])

    def _judged(self, T: F64, iterations: int) -> tuple[Solution, float]:
        """Find a set of closures that is the set of those which agree with its own optimum.

        Returns:
            The solution, and the limit of the squared errors of those which agree.
        """
        prior = self.options.switch_prior
        u = self.loops.squared_errors(T)
        price = prior
        while True:  # on to the price that the accuracy of this graph deserves
            wanted = prior * min(variance_factor(u[u < 2.0 * price]), 1.0)
            if price <= wanted * 1.5:
                break
            price = max(price / _PRICE_RATIO, wanted)
            T, used = self._stage(T, price)
            iterations += used
            u = self.loops.squared_errors(T)
        kept = u < 2.0 * price
        optimizer, limit = self.optimizer.plain(), prior
        for _ in range(_VERDICTS):
            T, used, u, limit = self._measured(optimizer, T, kept)
            iterations += used
            before, kept = kept, with_tail(u, limit)
            core = u <= limit
            if np.any(kept & ~core):  # true ones with larger errors, or false ones that bend all?
                T, used, u, limit = self._measured(optimizer, T, core)
                iterations += used
                kept = with_tail(u, limit)
            if np.array_equal(before, kept):
                break
        optimizer.trust(kept)
        T, used = self._finish(optimizer, T, 1.0)
        first, last = (optimizer.cost(x, 1.0) for x in (self.T_G_I, T))
        return Solution(T, kept.astype(np.float64), iterations + used, first, last), limit

    def _measured(
        self, optimizer: PoseGraphOptimizer, T: F64, kept: NDArray[np.bool_]
    ) -> tuple[F64, int, F64, float]:
        """Optimise with some closures; return poses, iterations, independent errors, their limit."""
        optimizer.trust(kept)
        T, iterations = optimizer.run(T, 1.0, self.options.num_iterations, self.progress)
        uncertainty = optimizer.closure_uncertainty(T)
        u = independent_errors(self.loops.errors(T), uncertainty, kept)
        return T, iterations, u, self.options.switch_prior * variance_factor(u[kept])

    def _anneal(self, share: float, price: float) -> tuple[F64, int]:
        """Go down in price until just above the one given."""
        highest = float(np.quantile(self.loops.squared_errors(self.T_G_I), share))
        stages = int(np.ceil(np.log(max(highest / price, 1.0)) / np.log(_PRICE_RATIO)))
        T, iterations = self.T_G_I, 0
        for stage in range(stages, -1, -1):
            T, used = self._stage(T, price * _PRICE_RATIO**stage)
            iterations += used
            self.progress.step(stages + 1 - stage, stages + 1, "relaxing")
        return T, iterations

    def _stage(self, T: F64, price: float) -> tuple[F64, int]:
        return self.optimizer.run(T, price, _STAGE_ITERATIONS, self.progress)

    def _finish(self, optimizer: PoseGraphOptimizer, T: F64, price: float) -> tuple[F64, int]:
        options = self.options
        return optimizer.run(
            T, price, options.num_iterations, self.progress, options.function_tolerance
        )

    def _solution(self, T: F64, weight: F64, iterations: int, price: float) -> Solution:
        before, after = (self.optimizer.cost(x, price) for x in (self.T_G_I, T))
        return Solution(T, weight, iterations, before, after)


def _best(solutions: list[Solution], cost: list[float]) -> Solution:
    best = solutions[int(np.argmin(cost))]
    return dataclasses.replace(best, iterations=sum(s.iterations for s in solutions))
