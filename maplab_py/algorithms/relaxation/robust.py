"""Robust optimisation of a pose graph: ever stricter losses, then a test of every closure.

Far from the optimum true and false closures have equally large residuals. Hence the loss starts where most
closures have weight and becomes stricter step by step (graduated non-convexity: Yang et al., RA-L 2020).
"""

import dataclasses

import numpy as np

from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.array_types import F64, Mask
from maplab_py.estimation.kernels.loss import loss_and_weight
from maplab_py.estimation.linear.threads import single_blas_thread
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem import pose_graph, solver, trust_region
from maplab_py.estimation.terms.pose_graph import RelativePoses, TiltPriors
from maplab_py.geometry import symmetric
from maplab_py.progress import Progress

_LOSSES = {
    "none": Loss.NONE,
    "gnc": Loss.DCS,
    "dcs": Loss.DCS,
    "switchable": Loss.GEMAN_MCCLURE,
    "cauchy": Loss.CAUCHY,
}
"""The squared scale of each is the penalty phi of switching a closure off. With the best switch s in
[0, 1] for each closure, s^2 u + phi (1 - s)^2 (Suenderhauf and Protzel, IROS 2012, with gamma = 1 and
the linear switch function) is Geman and McClure's loss: s = phi / (phi + u)."""
_PENALTY_RATIO = 4.0  # from one stage to the next
_STAGE_ITERATIONS = 4
_STAGE_TOLERANCE = 1e-7
_SOLVER = solver.SolverOptions(
    initial_radius=1e8,
    min_radius=1e-8,
    max_radius=1e12,
    function_tolerance=1e-12,
    gradient_tolerance=0.0,
    parameter_tolerance=0.0,
)
_NEWTON_RADIUS = 2e3
"""Second derivatives are seldom positive definite without some damping."""
_SLOW_RATIO = 0.05
_STARTS = (1.0, 0.5)
"""Shares of the closures that count in the beginning. All of them: right where drift is large. Half
of them: right where false ones would turn the graph inside out."""
_TRUSTED = 0.5  # weight
_MAX_TESTS = 8
_SUM_SIGMAS = 3.0
"""Factor by which the sum of squared errors of a graph without false closures may exceed its expectation."""


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """Poses of all vertices, and verdicts on the loop closures."""

    T_G_I: F64  # (V, 7)
    weight: F64  # (E,) of every closure, 1 = trusted, 0 = switched off
    iterations: int
    cost_before: float
    cost_after: float


@single_blas_thread()  # entered once, not at every solution
def optimize_robustly(
    T_G_I: F64,
    is_free: Mask,
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

    Raises:
        EstimationError: The poses are not determined, or not finite.
    """
    loss = _LOSSES[options.robustness]
    problem = pose_graph.PoseGraphProblem(is_free, trajectory, loops, tilt, loss)
    graph = _Graph(T_G_I, problem, loops, loss, options, progress)
    if options.robustness == "gnc":
        return graph.consistent()
    if options.robustness == "none":
        return graph.plain()
    return graph.annealed()


@dataclasses.dataclass(frozen=True, eq=False)
class _Graph:
    """Data that all ways of optimising a graph need."""

    T_G_I: F64
    problem: pose_graph.PoseGraphProblem
    loops: RelativePoses
    loss: Loss
    options: RelaxationOptions
    progress: Progress

    def plain(self) -> Solution:
        T, iterations = self._finish(self.problem, self.T_G_I)
        return self._solution(T, np.ones(len(self.loops)), iterations)

    def annealed(self) -> Solution:
        """Lower the switch penalty to the given value; return the start with the least cost."""
        penalty = self.options.switch_prior
        solutions: list[Solution] = []
        for share in _STARTS:
            T, iterations = self._anneal(share, penalty)
            T, more = self._finish(self.problem, T)
            weight = loss_and_weight(self.loss, penalty, self.loops.squared_errors(T))[1]
            solutions.append(self._solution(T, weight, iterations + more))
            if np.all(weight > _TRUSTED):
                break
        return _best(solutions, [s.cost_after for s in solutions])

    def consistent(self) -> Solution:
        """Find the closures that agree, and trust those fully and the others not at all.

        Begins in several ways, if the first does not trust all. The least truncated cost wins: what
        the trusted ones cost, and the limit for each of the others.
        """
        plain, spent = self._undisputed()
        if plain is not None:
            return plain
        solutions: list[Solution] = []
        limits: list[float] = []
        for share in _STARTS:
            T, iterations = self._anneal(share, self.options.switch_prior)
            solution, limit = self._test(T, iterations + spent)
            spent = 0
            solutions.append(solution)
            limits.append(limit)
            if np.all(solution.weight == 1.0):
                break
        off = max(limits)
        return _best(solutions, [s.cost_after + off * np.sum(1.0 - s.weight) for s in solutions])

    def _undisputed(self) -> tuple[Solution | None, int]:
        """Trust all closures, if nothing speaks against any; also return the iterations.

        Neither a closure against all others, nor the sum of all squared errors, which false closures
        that agree with one another raise where they deform the trajectories.
        """
        everything = np.ones(len(self.loops), dtype=np.bool_)
        problem = self.problem.without_loss()
        if problem.redundancy <= 0:
            return None, 0
        problem.set_active(everything)
        T, iterations = self._solve(
            problem, self.T_G_I, self.options.num_iterations, _STAGE_TOLERANCE
        )
        tail = _SUM_SIGMAS * np.sqrt(2.0 * problem.redundancy)
        if problem.cost(T) > problem.redundancy + tail:
            return None, iterations
        uncertainty = problem.closure_uncertainty(T)
        u = independent_errors(self.loops.errors(T), uncertainty, everything)
        if u.max() > largest_error(len(u)) * min(variance_factor(u), 1.0):
            return None, iterations
        T, more = self._finish(problem, T)
        first, last = problem.cost(self.T_G_I), problem.cost(T)
        weight = everything.astype(np.float64)
        return Solution(T, weight, iterations + more, first, last), iterations

    def _test(self, T: F64, iterations: int) -> tuple[Solution, float]:
        """Find a set of closures that is the set of those which agree with its own optimum.

        Returns:
            The solution, and the limit of the squared errors of those which agree.
        """
        prior = self.options.switch_prior
        u = self.loops.squared_errors(T)
        penalty = prior
        while True:  # on to the penalty that the accuracy of this graph deserves
            wanted = prior * min(variance_factor(u[u < 2.0 * penalty]), 1.0)
            if penalty <= wanted * 1.5:
                break
            penalty = max(penalty / _PENALTY_RATIO, wanted)
            T, used = self._stage(T, penalty)
            iterations += used
            u = self.loops.squared_errors(T)
        kept = u < 2.0 * penalty
        problem, limit = self.problem.without_loss(), prior
        for _ in range(_MAX_TESTS):
            T, used, u, limit = self._measure(problem, T, kept)
            iterations += used
            before, kept = kept, with_tail(u, limit)
            core = u <= limit
            # true closures with larger errors, or false ones that distort all?
            if np.any(kept & ~core):
                T, used, u, limit = self._measure(problem, T, core)
                iterations += used
                kept = with_tail(u, limit)
            if np.array_equal(before, kept):
                break
        problem.set_active(kept)
        T, used = self._finish(problem, T)
        first, last = problem.cost(self.T_G_I), problem.cost(T)
        return Solution(T, kept.astype(np.float64), iterations + used, first, last), limit

    def _measure(
        self, problem: pose_graph.PoseGraphProblem, T: F64, kept: Mask
    ) -> tuple[F64, int, F64, float]:
        """Optimise with some closures; return poses, iterations, independent errors, their limit."""
        problem.set_active(kept)
        T, iterations = self._solve(problem, T, self.options.num_iterations, _STAGE_TOLERANCE)
        uncertainty = problem.closure_uncertainty(T)
        u = independent_errors(self.loops.errors(T), uncertainty, kept)
        return T, iterations, u, self.options.switch_prior * variance_factor(u[kept])

    def _anneal(self, share: float, penalty: float) -> tuple[F64, int]:
        """Lower the switch penalty until just above the one given."""
        highest = float(np.quantile(self.loops.squared_errors(self.T_G_I), share))
        stages = int(np.ceil(np.log(max(highest / penalty, 1.0)) / np.log(_PENALTY_RATIO)))
        T, iterations = self.T_G_I, 0
        for stage in range(stages, -1, -1):
            T, used = self._stage(T, penalty * _PENALTY_RATIO**stage)
            iterations += used
            self.progress.step(stages + 1 - stage, stages + 1, "relaxing")
        return T, iterations

    def _stage(self, T: F64, penalty: float) -> tuple[F64, int]:
        self.problem.set_squared_scale(penalty)
        return self._solve(self.problem, T, _STAGE_ITERATIONS, _STAGE_TOLERANCE)

    def _finish(self, problem: pose_graph.PoseGraphProblem, T: F64) -> tuple[F64, int]:
        options = self.options
        return self._solve(problem, T, options.num_iterations, options.function_tolerance)

    def _solve(
        self, problem: pose_graph.PoseGraphProblem, T: F64, num_iterations: int, tolerance: float
    ) -> tuple[F64, int]:
        """Return poses and accepted steps.

        Where residuals stay large Gauss-Newton takes hundreds of steps, and Newton a dozen; far from
        the optimum Newton leads astray.
        """
        problem.set_second_order(False)
        options = dataclasses.replace(
            _SOLVER,
            num_iterations=num_iterations,
            forecast_tolerance=tolerance,
            slow_ratio=_SLOW_RATIO if problem.can_have_second_order else 1.0,
        )
        T, summary = solver.optimize_states(problem, T, options, self.progress)
        iterations = summary.iterations - summary.rejected_steps
        if summary.termination != solver.SLOW_CONVERGENCE:
            return T, iterations
        problem.set_second_order(True)
        rest = dataclasses.replace(
            options,
            num_iterations=num_iterations - summary.iterations,
            initial_radius=_NEWTON_RADIUS,
            schedule=trust_region.Schedule.CERES,
            slow_ratio=1.0,
        )
        T, newton = solver.optimize_states(problem, T, rest, self.progress)
        return T, iterations + newton.iterations - newton.rejected_steps

    def _solution(self, T: F64, weight: F64, iterations: int) -> Solution:
        before, after = (self.problem.cost(x) for x in (self.T_G_I, T))
        return Solution(T, weight, iterations, before, after)


def _best(solutions: list[Solution], cost: list[float]) -> Solution:
    best = solutions[int(np.argmin(cost))]
    return dataclasses.replace(best, iterations=sum(s.iterations for s in solutions))


# Consistency of loop closures with a solution: errors measured against the graph's own accuracy.
#
# The covariances of a graph are often off by a common factor. Adjustment theory estimates it from the
# graph: the weighted sum of squares over the number of redundant measurements, the VARIANCE FACTOR (the
# a posteriori variance of unit weight). Errors of closures that agree, divided by it, are chi-squared
# with six degrees of freedom or, in real data, have a longer tail; those of false ones are larger by
# orders of magnitude. In between there is a gap, and closures are told apart there.

_SMALLEST_FACTOR, _LARGEST_FACTOR = 1e-6, 4.0
_MEDIAN = 5.348  # of chi-squared with six degrees of freedom
_GIVEN = 50  # closures that weigh as much as the covariances as given
_NOTHING_ELSE = 1e-3
"""Redundancy below which other closures do not control one."""
_SELDOM = 0.01
_GAP = 2.0
"""Ratio of neighbouring squared errors that separates true from false ones."""
_TAIL = 0.25
"""Share of the closures below the limit that may be added as their tail."""
_WIDEST = 100.0
"""Times the limit: that far from it nothing is a tail."""


def variance_factor(u: F64) -> float:
    """Return the variance factor that independent errors of agreeing closures (E,) show.

    By their median, which some false ones among them change little. Few closures show little: the
    covariances as given count as much as fifty closures would, in terms of logarithms.
    """
    if len(u) == 0:
        return 1.0
    shown = max(float(np.median(u)) / _MEDIAN, 1e-300)
    factor = shown ** (len(u) / (len(u) + _GIVEN))
    return float(np.clip(factor, _SMALLEST_FACTOR, _LARGEST_FACTOR))


def independent_errors(error: F64, uncertainty: F64, counts: Mask) -> F64:
    """Return the squared normalised errors (E,) of closures as predicted by all OTHERS.

    A closure that counts pulls the solution and looks better than it is; one that does not count is
    measured against poses that are uncertain themselves. Both are put right by the covariance of the
    error (Baarda 1968, data snooping): I - P and I + P for the uncertainty P of the poses. The only
    closure that holds a part of the graph has nothing to be measured against, and no error.

    Args:
        error: Whitened errors (E, 6).
        uncertainty: P (E, 6, 6), whitened as well.
        counts: Which closures (E,) are part of the solution.
    """
    sign = np.where(counts, -1.0, 1.0)[:, None, None]
    covariance = np.eye(6) + sign * uncertainty
    value, vector = symmetric.eigen(covariance)
    along = np.einsum("eij,ei->ej", vector, error)
    return np.asarray(np.sum(along**2 / np.maximum(value, _NOTHING_ELSE), axis=1))


def largest_error(count: int) -> float:
    """Return what the largest of `count` squared errors of true closures exceeds once in a hundred graphs.

    Chi-squared with six degrees of freedom, without the longer tail of real data.
    """
    from scipy.special import chdtri

    return float(chdtri(6, _SELDOM / max(count, 1)))


def with_tail(u: F64, limit: float) -> Mask:
    """Return which closures (E,) agree, if the errors of those which do have a longer tail.

    Up from the limit, those are added which follow closely upon one another. When they are too many
    for a tail there is no gap between true and false ones, and the limit itself decides.

    Args:
        u: Squared normalised errors.
        limit: Below it all agree.
    """
    above = np.sort(u[u > limit])
    step = np.append(above, np.inf) / np.append(limit, above)
    tail = int(np.argmax(step > _GAP))
    if tail == 0 or tail > _TAIL * np.count_nonzero(u <= limit):
        return np.asarray(u <= limit)
    return np.asarray(u <= min(above[tail - 1], _WIDEST * limit))
