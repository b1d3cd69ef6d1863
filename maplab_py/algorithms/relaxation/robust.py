"""The robust optimisation of a pose graph: a sequence of ever stricter losses."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.relaxation.losses import LOSSES
from maplab_py.algorithms.relaxation.optimizer import PoseGraphOptimizer
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.pose_graph import RelativePoses, TiltPriors
from maplab_py.progress import Progress

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_PRICE_RATIO = 4.0  # from one stage to the next
_STAGE_ITERATIONS = 4


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

    The price of switching a closure off starts where it is dearer than any error and falls to the
    one asked for; each stage begins with the result of the one before it.

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
    loss = LOSSES[options.robustness]
    final = options.switch_prior
    optimizer = PoseGraphOptimizer(is_free, trajectory, loops, tilt, options.robustness)
    largest = float(np.max(loops.squared_errors(T_G_I)))
    stages = int(np.ceil(np.log(max(largest / final, 1.0)) / np.log(_PRICE_RATIO)))
    if options.robustness == "none":
        stages = 0
    cost_before = optimizer.cost(T_G_I, final)
    T, iterations = T_G_I, 0
    for stage in range(stages, -1, -1):
        price = final * _PRICE_RATIO**stage
        limit = options.num_iterations if stage == 0 else _STAGE_ITERATIONS
        T, used = optimizer.run(T, price, limit, progress)
        iterations += used
        progress.step(stages + 1 - stage, stages + 1, "relaxing")
    weight = loss(loops.squared_errors(T), final)[1]
    return Solution(T, weight, iterations, cost_before, optimizer.cost(T, final))
