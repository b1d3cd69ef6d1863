"""T_G_M from observations of a map with all poses in M fixed (SWL).

Source: Oleynikova et al., Real-Time Visual-Inertial Localization for Aerial and Ground Robots, IROS 2015,
as Schneider 2019, Paper I, section 4.1 describes it.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.linear.protocol import NotPositiveDefinite
from maplab_py.estimation.problem.protocol import Step
from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.estimation.problem.trust_region import added_damping
from maplab_py.estimation.window.map_terms import MapTerms
from maplab_py.estimation.window.states import WindowStates
from maplab_py.geometry import se3, so3
from maplab_py.progress import SILENT


@dataclasses.dataclass(frozen=True, eq=False)
class AlignmentLinearization:
    """Normal equations of T_G_M."""

    square: F64  # (6, 6)
    gradient: F64  # (6,)
    costs: dict[str, float]


class AlignmentProblem:
    """Observations of a map, and a prior on T_G_M; see `problem.protocol.LeastSquares`."""

    def __init__(self, terms: MapTerms, T_G_M: F64, sigma: F64) -> None:
        """Take observations of landmarks that are exact, and a prior (7,) with deviations (6,)."""
        self._terms, self._T_G_M, self._sigma = terms, T_G_M, sigma

    def relinearize(self, states: WindowStates) -> bool:  # noqa: ARG002
        """Return False: nothing is linearised anywhere else."""
        return False

    def linearize(
        self,
        states: WindowStates,
        damping: float,  # noqa: ARG002
    ) -> AlignmentLinearization:
        """Form the normal equations."""
        square, gradient, costs = self._terms.of_base_frame(states)
        residual, jacobian = self._prior(states)
        square = square + jacobian.T @ jacobian
        gradient = gradient + jacobian.T @ residual
        costs["prior"] = 0.5 * float(residual @ residual)
        return AlignmentLinearization(square, gradient, costs)

    def try_step(
        self, states: WindowStates, linear: AlignmentLinearization, damping: float
    ) -> Step[WindowStates]:
        """Return the states after the damped step of T_G_M.

        Raises:
            NotPositiveDefinite: The damped equations are singular.
        """
        added = added_damping(np.diagonal(linear.square), damping)
        try:
            step = np.linalg.solve(linear.square + np.diag(added), -linear.gradient)
        except np.linalg.LinAlgError:
            raise NotPositiveDefinite(0) from None
        every = np.zeros(FRAME_SIZE * len(states) + len(states.calibration) + 6)
        every[-6:] = step
        moved = states.moved(every, states.h)
        residual, _ = self._prior(moved)
        costs = self._terms.costs(moved) | {"prior": 0.5 * float(residual @ residual)}
        promised = 0.5 * float((added * step - linear.gradient) @ step)
        return Step(moved, costs, promised, float(np.linalg.norm(step)))

    def is_stationary(self, linear: AlignmentLinearization, tolerance: float) -> bool:
        """Return whether no entry of the gradient is above a tolerance."""
        return bool(np.abs(linear.gradient).max() <= tolerance)

    def norm(self, states: WindowStates) -> float:
        """Return the norm of T_G_M."""
        return float(np.linalg.norm(states.T_G_M))

    def _prior(self, states: WindowStates) -> tuple[F64, F64]:
        offset = se3.local(self._T_G_M, states.T_G_M[0])
        slope = np.eye(6)
        slope[3:, 3:] = so3.right_jacobian_inverse(offset[3:])
        return offset / self._sigma, slope / self._sigma[:, None]


def aligned(
    terms: MapTerms,
    states: WindowStates,
    sigma: F64,
    *,
    num_iterations: int = 10,
    function_tolerance: float = 1e-6,
) -> tuple[F64, F64]:
    """Return T_G_M (7,) of the states after the alignment, and its covariance (6, 6).

    Args:
        terms: Observations of the map by the frames of the states.
        states: The window, with a base frame to begin from; frames are not moved.
        sigma: Standard deviations (6,) [p, theta] of the base frame before anything is observed.
        num_iterations: Most iterations.
        function_tolerance: Relative decrease of the cost that ends them.

    Raises:
        EstimationError: The cost is not finite.
    """
    problem = AlignmentProblem(terms, states.T_G_M[0], sigma)
    solver = SolverOptions(num_iterations=num_iterations, function_tolerance=function_tolerance)
    result, _ = optimize_states(problem, states, solver, SILENT)
    covariance: F64 = np.asarray(np.linalg.inv(problem.linearize(result, 0.0).square))
    return result.T_G_M[0], covariance
