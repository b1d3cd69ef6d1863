"""A window as a least-squares problem: one dense system, from which landmarks are eliminated on the fly."""

import dataclasses
from types import ModuleType

import numpy as np
import scipy.linalg.lapack

from maplab_py.array_types import F64, I64
from maplab_py.estimation.kernels import window_arguments
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.loss import Loss
from maplab_py.estimation.problem.protocol import Step
from maplab_py.estimation.problem.trust_region import added_damping
from maplab_py.estimation.window.calibration import FrameTimes, WindowCalibration
from maplab_py.estimation.window.factors import EVERY, FrameFactors, Part
from maplab_py.estimation.window.map_terms import MapElimination, MapTerms
from maplab_py.estimation.window.prior import WindowPrior
from maplab_py.estimation.window.states import WindowStates, scale_sigma

_LANDMARK_DAMPING, _NEARLY_UNDAMPED = 1e-12, 1e-4
"""Relative damping of landmarks for covariances: those without parallax stay solvable; and largest."""


@dataclasses.dataclass(frozen=True, eq=False)
class WindowLinearization:
    """Normal equations at some states, and the data for steps of landmarks."""

    system: window_arguments.DenseSystem
    kept: window_arguments.Elimination
    rule: window_arguments.WindowRule
    costs: dict[str, float]
    of_map: MapElimination | None = None


class WindowProblem:
    """Observations, factors between frames, and the prior; see `problem.protocol.LeastSquares`."""

    def __init__(
        self,
        kernels: ModuleType,
        data: window_arguments.WindowData,
        calibration: WindowCalibration,
        factors: FrameFactors,
        prior: WindowPrior,
        *,
        loss: Loss = Loss.HUBER,
        map_terms: MapTerms | None = None,
        times: FrameTimes | None = None,
    ) -> None:
        """Join the measurements.

        Args:
            kernels: Compiled from the template `window` for the cameras' models.
            data: Observations, grouped by landmark.
            calibration: Of the cameras, as the observations count them.
            factors: Of the frames.
            prior: From what has left the window.
            loss: Robust loss of reprojection errors.
            map_terms: Observations of a map, for states with a base frame; None = there are none.
            times: When images were taken; None = all rows at the times of the frames.
        """
        self._kernels, self._data, self._calibration = kernels, data, calibration
        self._times = times
        self._factors, self._prior, self._loss = factors, prior, loss
        self._map_terms = map_terms
        self._latest: WindowLinearization | None = None

    def relinearize(self, states: WindowStates) -> bool:
        """Integrate edges again whose biases have changed much; return whether there were any."""
        return self._factors.chain.relinearize(states.motion)

    def linearize(self, states: WindowStates, damping: float) -> WindowLinearization:
        """Form the normal equations; `damping` enters the elimination of the landmarks."""
        self._latest = self._linearize(states, damping, EVERY)
        return self._latest

    def undamped(self, states: WindowStates, part: Part) -> WindowLinearization:
        """Form the equations of some factors, the prior and all observations of this problem."""
        return self._linearize(states, _LANDMARK_DAMPING, part)

    def try_step(
        self, states: WindowStates, linear: WindowLinearization, damping: float
    ) -> Step[WindowStates]:
        """Return the states after the damped step, landmarks moved along with it.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        system, rule = linear.system, linear.rule
        added = added_damping(system.diagonal, damping)
        matrix = system.matrix.copy()
        matrix.reshape(-1)[:: len(matrix) + 1] += added
        step = -self._solved(_factorised(matrix), system.reduced_gradient)
        moved = states.moved(step, np.empty_like(states.h))
        rho, promised, norm2 = self._kernels.substitute(
            self._data, self._point(states), rule, linear.kept, step, self._point(moved)
        )
        promised += 0.5 * float(np.dot(added * step - system.gradient, step))
        costs = self._factors.costs(moved)
        residual = self._prior.evaluate(moved)
        costs |= {"visual": 0.5 * rho, "prior": 0.5 * float(np.vdot(residual, residual))}
        if linear.of_map is not None:
            p_G, promised_by_map = linear.of_map.step(states.p_G, step)
            norm2 += float(np.sum((p_G - states.p_G) ** 2))
            moved, promised = dataclasses.replace(moved, p_G=p_G), promised + promised_by_map
        if self._map_terms is not None:
            costs |= self._map_terms.costs(moved)
        return Step(moved, costs, promised, float(np.sqrt(norm2 + np.vdot(step, step))))

    def is_stationary(self, linear: WindowLinearization, tolerance: float) -> bool:
        """Return whether no entry of the gradient is above a tolerance."""
        gradients = (linear.system.gradient, linear.kept.gradient)
        return all(np.abs(g).max(initial=0.0) <= tolerance for g in gradients)

    def norm(self, states: WindowStates) -> float:
        """Return the norm of all values."""
        return states.size()

    def errors(self, states: WindowStates) -> tuple[F64, F64]:
        """Return reprojection error [px] and depth [m] (O,) of every observation."""
        result = np.empty((len(self._data.frame), 2))
        self._kernels.evaluate(self._data, self._point(states), result)
        return result[:, 0], result[:, 1]

    def undamped_near(self, states: WindowStates) -> WindowLinearization:
        """Return equations for covariances at converged states.

        Those of the last iteration serve unless landmarks were damped: a step smaller than the tolerance
        of the solver changes no covariance that matters, and to linearise takes a tenth of an update.
        """
        if self._latest is not None and self._latest.rule.damping <= _NEARLY_UNDAMPED:
            return self._latest
        return self.linearize(states, _LANDMARK_DAMPING)

    def covariance_of_all(self, states: WindowStates) -> F64:
        """Return the joint covariance (n, n) of the whole system at converged states; see `covariance`.

        Raises:
            NotPositiveDefinite: The measurements do not determine the frames.
        """
        matrix = self.undamped_near(states).system.matrix.copy()
        lower, _ = scipy.linalg.lapack.dpotri(_factorised(matrix), lower=0)
        upper = np.triu(lower)
        return np.asarray(upper + np.triu(upper, 1).T)

    def covariance(self, states: WindowStates, rows: I64) -> F64:
        """Return the joint covariance (n, n) of rows (n,) of the system; infinite = not determined.

        Frames come first, each [p, theta, v, b_g, b_a], then the calibration, and the base frame.
        """
        try:
            matrix = self.undamped_near(states).system.matrix.copy()
            columns = np.zeros((len(matrix), len(rows)))
            columns[rows, np.arange(len(rows))] = 1.0
            block = self._solved(_factorised(matrix), columns)[rows]
        except NotPositiveDefinite:
            return np.full((len(rows), len(rows)), np.inf)
        return np.asarray(0.5 * (block + block.T))

    def scale_sigma(self, states: WindowStates) -> float:
        """Return the standard deviation of the scale of the positions, as a share; infinite = unknown."""
        try:
            covariance = self.covariance_of_all(states)
        except NotPositiveDefinite:
            return float("inf")
        size = window_arguments.FRAME_SIZE * len(states)
        return scale_sigma(states.T_M_I[:, 4:], covariance[:size, :size])

    def calibration_sigma(self, states: WindowStates) -> F64:
        """Return the standard deviations (K,) of the calibration; infinite = unknown."""
        rows = window_arguments.FRAME_SIZE * len(states) + np.arange(len(self._calibration))
        return np.sqrt(np.maximum(np.diagonal(self.covariance(states, rows)), 0.0))

    def _linearize(self, states: WindowStates, damping: float, part: Part) -> WindowLinearization:
        frames, landmarks = len(states), len(states.h)
        count = len(states.calibration)
        system = window_arguments.DenseSystem.zeros(
            window_arguments.FRAME_SIZE * frames + count + 6 * len(states.T_G_M)
        )
        kept = window_arguments.Elimination.empty(landmarks, frames, count)
        at, is_elsewhere = states, np.zeros(frames, dtype=np.bool_)
        fixed = self._prior.is_fixed
        if fixed.any() or self._prior.is_base_fixed:
            at, is_elsewhere = self._prior.linearization_point(states), fixed
        rule = window_arguments.WindowRule(int(self._loss), float(damping), at.T_M_I, is_elsewhere)
        rho = self._kernels.eliminate(self._data, self._point(states), rule, system, kept)
        costs = {"visual": 0.5 * float(rho), **self._factors.add_to(system, states, at, part)}
        residual, information, gradient = self._prior.linearized(states)
        costs["prior"] = 0.5 * float(np.vdot(residual, residual))
        of_map = None
        if self._map_terms is not None:
            of_map, of_kind = self._map_terms.add_to(system, states, at)
            costs |= of_kind
        np.add(system.matrix, information, out=system.matrix)
        np.add(system.diagonal, np.diagonal(information), out=system.diagonal)
        np.add(system.gradient, gradient, out=system.gradient)
        np.add(system.reduced_gradient, system.gradient, out=system.reduced_gradient)
        return WindowLinearization(system, kept, rule, costs, of_map)

    def _point(self, states: WindowStates) -> window_arguments.WindowPoint:
        twist = np.zeros((0, 7)) if self._times is None else self._times.twist(states)
        cameras = self._calibration.of_kernels(states.calibration)
        return window_arguments.WindowPoint(states.T_M_I, states.h, cameras, twist)

    @staticmethod
    def _solved(factor: F64, right: F64) -> F64:
        solution, _ = scipy.linalg.lapack.dpotrs(factor, right, lower=0)
        return np.asarray(solution)


def _factorised(matrix: F64) -> F64:
    """Return the Cholesky factor of a matrix given by its lower triangle, which is overwritten.

    Raises:
        NotPositiveDefinite: The matrix is singular; the node is the frame's.
    """
    factor, info = scipy.linalg.lapack.dpotrf(matrix.T, lower=0, clean=0, overwrite_a=1)
    if info > 0:
        raise NotPositiveDefinite((info - 1) // window_arguments.FRAME_SIZE)
    return np.asarray(factor)
