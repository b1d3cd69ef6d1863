"""A problem whose steps come from conjugate gradients; the reduced system is never formed.

Stored between calls: 12 single-precision numbers per observation, 15 per landmark, the poses' diagonal
blocks, and the factors' Jacobians. A step is a truncated Newton step; the trust region compares it with
the decrease that the quadratic model predicts, like any other step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import NoReturn

import numpy as np

from maplab_py.array_types import F64, I32, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.kernels.schur_products import multiply_factors
from maplab_py.estimation.linear.conjugate_gradients import CGResult, conjugate_gradients
from maplab_py.estimation.linear.ordering import Ordering
from maplab_py.estimation.linear.supernodal_solver import SupernodalCholesky
from maplab_py.estimation.problem.preconditioner import Preconditioner
from maplab_py.estimation.problem.problem import Linearization, Problem
from maplab_py.estimation.problem.protocol import Step
from maplab_py.estimation.problem.trust_region import added_damping
from maplab_py.estimation.states import States
from maplab_py.estimation.terms import factor as factor_terms
from maplab_py.estimation.terms.prior import PosePrior
from maplab_py.estimation.terms.protocol import FactorTerm
from maplab_py.estimation.terms.visual import Observations, VisualTerms, pose_part, sample_terms
from maplab_py.estimation.terms.visual_products import PoseSystem, VisualProducts
from maplab_py.geometry import se3
from maplab_py.memory import NotEnoughMemory


@dataclasses.dataclass(frozen=True)
class IterativeOptions:
    """Accuracy of steps, and conditions for a return to the direct solver."""

    forcing: float = 0.01  # share of the preconditioned residual that a step may leave
    tightening: float = 0.01  # of the forcing, for the step that ends a run
    max_iterations: int = 500  # of a step
    budget: float = np.inf  # iterations that a factorisation is worth
    max_overruns: int = 2  # consecutive steps above the budget before the direct solver takes over
    covariance_residual: float = 1e-8
    covariance_iterations: int = 5000


class IterativeProblem(Problem):
    """A `Problem` solved by preconditioned conjugate gradients.

    Cameras that are estimated are not supported. Covariances come from the direct solver; where that
    does not fit, from conjugate gradients, one column at a time.
    """

    def __init__(
        self,
        states: States,
        visual: VisualTerms | None,
        factors: Sequence[FactorTerm],
        make_direct: Callable[[], Problem] | None = None,
        options: IterativeOptions | None = None,
        tell: Callable[[str], None] | None = None,
    ) -> None:
        """Analyse the preconditioner for states of this layout.

        Args:
            states: Initial states.
            visual: Reprojection errors of cameras that are not estimated.
            factors: All other terms.
            make_direct: Makes the same problem for the direct solver, nothing restricted.
            options: Tolerances.
            tell: Shows a line when the direct solver takes over.

        Raises:
            NotEnoughMemory: The Jacobians or the preconditioner do not fit.
            ValueError: The cameras are estimated.
        """
        if visual is not None and visual.estimates_cameras:
            raise ValueError("conjugate gradients do not support cameras that are estimated")
        self._options = options or IterativeOptions()
        self._make_direct = make_direct or partial(Problem, states, visual, factors)
        self._evaluated: Evaluation | None = None
        self._direct: Problem | None = None  # after it has taken over
        self._covariance_problem: Problem | None = None  # for covariances
        self._columns_of: tuple[ReducedOperator, F64] | None = None
        self._overruns = 0
        self._is_direct_refused = False
        self.iterations: list[int] = []
        """Iterations of every linear system that was solved for a step."""
        super().__init__(states, visual, factors, tell=tell)

    def _analyse(self, states: States, ordering: Ordering) -> None:  # noqa: ARG002
        self._products = None if self.visual is None else VisualProducts(self.visual)
        nodes = [term.nodes for term in self.factors]
        self._preconditioner = Preconditioner(states, nodes, self.visual is not None)
        self._held = np.zeros(0, dtype=np.int64)

    @property
    def solver(self) -> SupernodalCholesky | None:
        """The direct linear solver, once it has taken over."""
        return None if self._direct is None else self._direct.solver

    @property
    def linear_solver(self) -> str:
        """Name of the linear solver, and of the one that took over."""
        return "pcg" if self._direct is None else "pcg, then multifrontal"

    @property
    def linear_iterations(self) -> int:
        """Iterations of conjugate gradients for all steps so far."""
        return sum(self.iterations)

    def blocks(self, linear: Linearization, rows: I32, cols: I32) -> NoReturn:  # noqa: ARG002
        """Raise: the blocks are never formed."""
        raise ValueError("conjugate gradients form no blocks of the normal equations")

    # -- equations -------------------------------------------------------------------------------

    def relinearize(self, states: States) -> bool:
        """Move the terms' linearisation points to the states; return whether costs may have changed."""
        has_changed = super().relinearize(states)
        if has_changed:
            self._evaluated = None
        return has_changed

    def linearize(self, states: States, damping: float) -> Linearization:
        """Evaluate at the states, unless it is those of the last call; eliminate the landmarks."""
        if self._direct is None and self._overruns >= self._options.max_overruns:
            self._return_to_direct()
        if self._direct is not None:
            return self._direct.linearize(states, damping)
        seen = None if self.visual is None else self.visual.observations
        at = self._evaluated
        if at is None or at.states is not states or at.observations is not seen:
            self._evaluated = at = self._evaluate(states, seen)
        gradient, pose_blocks = at.gradient.copy(), np.zeros((0, 6, 6))
        if self._products is not None and at.poses is not None:
            reduced = self._products.eliminate(at.poses, damping)
            pose_part(gradient, states)[:] += reduced.gradient
            pose_blocks = reduced.blocks
        return ReducedOperator(
            states=states,
            landmark_damping=damping,
            gradient=gradient,
            diagonal=at.diagonal,
            factors=at.factors,
            costs=dict(at.costs),
            pose_blocks=pose_blocks,
            factor_blocks=at.factor_blocks,
        )

    def _evaluate(self, states: States, observations: Observations | None) -> Evaluation:
        gradient, diagonal = np.zeros((self.num_nodes, 3)), np.zeros((self.num_nodes, 3))
        costs: dict[str, float] = {}
        poses = None
        if self._products is not None:
            poses, costs["visual"] = self._products.evaluate(states)
            pose_part(diagonal, states)[:] += np.einsum("vii->vi", poses.blocks)
        factors, blocks = [], []
        for term in self.factors:
            count = len(term.nodes) * factor_terms.blocks_each(term.nodes)
            blocks.append(np.empty((count, 3, 3)))
            system, residual, jacobian = factor_terms.linearize(
                term, states, partial(_write, blocks[-1])
            )
            np.add.at(gradient, term.nodes, system.gradient)
            np.add.at(diagonal, term.nodes, system.diagonal)
            factors.append((term.nodes, residual, np.ascontiguousarray(jacobian)))
            costs[term.name] = costs.get(term.name, 0.0) + system.cost
        return Evaluation(states, observations, poses, gradient, diagonal, factors, blocks, costs)

    def _multiply(self, linear: ReducedOperator, added: F64, x: F64) -> F64:
        """Return P A P x (nodes, 3) for x in the range of the projectors P."""
        y = added * x
        for nodes, _, jacobian in linear.factors:
            multiply_factors(nodes, jacobian, x, y)
        if self._products is not None:
            pose_part(y, linear.states)[:] += self._products.multiply(pose_part(x, linear.states))
        return self._projected(y)

    def _projected(self, y: F64) -> F64:
        """Remove, in place, the directions that must not move."""
        held = self._held
        y[held] = np.einsum("nij,nj->ni", self._projector[held], y[held])
        return y

    # -- steps -----------------------------------------------------------------------------------

    def solve(self, linear: Linearization, damping: float) -> F64:
        """Return a truncated Newton step (nodes, 3).

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        if not isinstance(linear, ReducedOperator):
            return self._taking_over(linear).solve(linear, damping)
        return self._first_solved(linear, damping)

    def try_step(self, states: States, linear: Linearization, damping: float) -> Step[States]:
        """Return the states after a truncated Newton step, which `refine` solves again.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        if not isinstance(linear, ReducedOperator):
            return self._taking_over(linear).try_step(states, linear, damping)
        step = self._first_solved(linear, damping)
        taken = self._take_step(states, linear, damping, step)
        return dataclasses.replace(
            taken, refine=partial(self._refined, states, linear, damping, step)
        )

    def _refined(
        self, states: States, linear: ReducedOperator, damping: float, step: F64
    ) -> Step[States]:
        forcing = self._options.forcing * self._options.tightening
        exact = self._solve(linear, damping, forcing, step)
        return self._take_step(states, linear, damping, exact.x)

    def _first_solved(self, linear: ReducedOperator, damping: float) -> F64:
        """Return the truncated step (nodes, 3), and count steps above the budget."""
        result = self._solve(linear, damping, self._options.forcing, None)
        is_over = not result.has_converged or result.iterations > self._options.budget
        self._overruns = self._overruns + 1 if is_over else 0
        return result.x

    def _solve(
        self, linear: ReducedOperator, damping: float, forcing: float, initial: F64 | None
    ) -> CGResult:
        options = self._options
        added = self._prepare(linear, damping)
        result = self._conjugate_gradients(
            linear, added, -linear.gradient, forcing, options.max_iterations, initial
        )
        self.iterations.append(result.iterations)
        return result

    def _prepare(self, linear: ReducedOperator, damping: float) -> F64:
        """Factorise the preconditioner; return the damping (nodes, 3) that is added."""
        added = added_damping(linear.diagonal, damping)
        size = (linear.diagonal + added).max(axis=1, initial=1.0)
        self._held = np.flatnonzero(self._restricted)
        self._preconditioner.factor(
            added, linear.pose_blocks, linear.factor_blocks, self._projector, size
        )
        return added

    def _conjugate_gradients(
        self,
        linear: ReducedOperator,
        added: F64,
        right_side: F64,
        forcing: float,
        max_iterations: int,
        initial: F64 | None = None,
    ) -> CGResult:
        return conjugate_gradients(
            lambda x: self._multiply(linear, added, x),
            lambda r: self._projected(self._preconditioner.apply(r)),
            self._projected(right_side),
            forcing=forcing,
            max_iterations=max_iterations,
            initial=initial,
        )

    # -- the direct solver -------------------------------------------------------------------------

    def _return_to_direct(self) -> None:
        """Switch to the direct solver; where it does not fit, continue with truncated steps."""
        self._overruns = 0
        if self._is_direct_refused:
            return
        direct = self._direct_problem()
        self._is_direct_refused = direct is None
        line = "conjugate gradients take too many iterations: "
        if direct is not None:
            self._direct, self._evaluated = direct, None
        if self._tell is not None:
            outcome = "the factorisation does not fit, steps stay truncated"
            self._tell(line + (outcome if direct is None else "the direct solver takes over"))

    def _direct_problem(self) -> Problem | None:
        """Return the same problem for the direct solver; None where it does not fit."""
        try:
            direct = self._make_direct()
        except NotEnoughMemory:
            return None
        held = np.flatnonzero(self._restricted)
        direct.restrict(held, self._projector[held])
        return direct

    def _taking_over(self, linear: Linearization) -> Problem:
        if self._direct is None:
            raise TypeError(f"{type(linear).__name__} is not a linearisation of this problem")
        return self._direct

    # -- covariances -------------------------------------------------------------------------------

    def factorise(self, linear: Linearization, damping: float) -> None:
        """Prepare for covariances, by the direct solver where it fits.

        Raises:
            NotPositiveDefinite: The equations are singular.
        """
        self._columns_of, self._covariance_problem = None, self._direct
        if isinstance(linear, ReducedOperator):
            self._covariance_problem = self._direct_problem()
            if self._covariance_problem is None:
                self._columns_of = linear, self._prepare(linear, damping)
                return
            linear = self._covariance_problem.linearize(linear.states, linear.landmark_damping)
        if self._covariance_problem is not None:
            self._covariance_problem.factorise(linear, damping)

    def marginal_covariance(self, nodes: I64) -> F64:
        """Return the joint covariance (3 k, 3 k) of nodes (k,) after `factorise` without damping.

        Raises:
            EstimationError: Conjugate gradients do not converge.
        """
        if self._covariance_problem is not None:
            return self._covariance_problem.marginal_covariance(nodes)
        columns = self.covariance_columns(np.repeat(nodes, 3), np.tile(np.arange(3), len(nodes)))
        covariance = columns[nodes].reshape(3 * len(nodes), -1)
        return np.asarray(0.5 * (covariance + covariance.T))

    def covariance_columns(self, nodes: I64, directions: I64) -> F64:
        """Return the covariance (nodes, 3, k) of everything with directions (k,) of nodes (k,).

        Raises:
            EstimationError: Conjugate gradients do not converge.
        """
        if self._covariance_problem is not None:
            return self._covariance_problem.covariance_columns(nodes, directions)
        if self._columns_of is None:
            raise ValueError("factorise() has to succeed before covariances are asked for")
        linear, added = self._columns_of
        result = np.empty((self.num_nodes, 3, len(nodes)))
        for column, (node, direction) in enumerate(zip(nodes, directions, strict=True)):
            unit = np.zeros((self.num_nodes, 3))
            unit[node, direction] = 1.0
            solved = self._conjugate_gradients(
                linear, added, unit, self._options.covariance_residual,
                self._options.covariance_iterations,
            )  # fmt: skip
            if not solved.has_converged:
                raise EstimationError(
                    f"no covariance: conjugate gradients do not converge for node {node}; "
                    "allow the direct solver more memory (--ba_max_memory_gb)"
                )
            result[:, :, column] = solved.x
        return result


def _write(blocks: F64, values: F64, first: int) -> None:
    blocks[first : first + len(values)] = values


def compile_kernels() -> None:
    """Compile products and preconditioner."""
    visual, states = sample_terms()
    problem = IterativeProblem(states, visual, [])
    problem.fix(np.array([0, 1]))
    problem.try_step(states, problem.linearize(states, 1e-4), 1e-4)


def compile_without_images() -> None:
    """Compile the kernels of problems without landmarks."""
    zero = np.zeros((1, 3))
    prior = PosePrior(np.zeros(1, dtype=np.int64), se3.identity(1), np.eye(6))
    states = States(se3.identity(1), zero, zero, zero, zero)
    problem = IterativeProblem(states, None, [prior])
    problem.solve(problem.linearize(states, 1e-4), 1e-4)


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """Everything at some states that does not depend on the damping."""

    states: States
    observations: Observations | None
    poses: PoseSystem | None
    gradient: F64  # (nodes, 3) without landmarks' elimination
    diagonal: F64  # (nodes, 3)
    factors: list[tuple[I64, F64, F64]]
    factor_blocks: list[F64]
    costs: dict[str, float]


@dataclasses.dataclass(frozen=True, eq=False)
class ReducedOperator(Linearization):
    """Normal equations of which only the blocks for the preconditioner are formed.

    The next linearisation of the same problem writes into what products read.
    """

    pose_blocks: F64  # (V, 6, 6) diagonal blocks of the visual Schur complement
    factor_blocks: list[F64]
