"""Marginalization: states that leave the window become a prior on the remaining states."""

import dataclasses

import numpy as np

from maplab_py.estimation.kernels.window_arguments import FRAME_SIZE
from maplab_py.estimation.window.factors import Part
from maplab_py.estimation.window.prior import WindowPrior, schur_complement
from maplab_py.estimation.window.problem import WindowProblem
from maplab_py.estimation.window.states import WindowStates


def marginalized(
    problem: WindowProblem,
    prior: WindowPrior,
    states: WindowStates,
    *,
    frame: int | None,
) -> WindowPrior:
    """Return the marginal prior of all landmarks of a problem and, optionally, a frame.

    Frames that the result touches are fixed from now on at their states, or stay fixed where they
    were. A landmark is not touched: it is anchored in a frame that stays, or eliminated altogether.

    Args:
        problem: Prior and landmarks that are to be removed; of the factors only those of the frame
            and of the edges that meet in it are used.
        prior: The prior of the problem.
        states: Where to linearise what is not fixed.
        frame: Which frame is removed; None = only landmarks.
    """
    linear = problem.undamped(states, _factors_of(frame))
    lower = linear.system.matrix
    information = np.tril(lower) + np.tril(lower, -1).T
    fixed, is_base_fixed = prior.is_fixed, prior.is_base_fixed
    x0 = prior.linearization_point(states)
    offset = states.offsets(x0)
    gradient = linear.system.reduced_gradient - information @ offset
    if frame is not None:
        rows = FRAME_SIZE * frame + np.arange(FRAME_SIZE)
        information, gradient = schur_complement(information, gradient, rows)
        x0, fixed = x0.without_frame(frame), np.delete(fixed, frame)
    result = WindowPrior.of_information(information, gradient, x0, fixed)
    is_base_fixed = is_base_fixed or result.touches_base
    return dataclasses.replace(result, is_fixed=result.touched, is_base_fixed=is_base_fixed)


def _factors_of(frame: int | None) -> Part:
    """Return the factors of a frame, and its edges."""
    if frame is None:
        return Part(slice(0, 0), slice(0, 0))
    return Part(slice(max(frame - 1, 0), frame + 1), slice(frame, frame + 1))
