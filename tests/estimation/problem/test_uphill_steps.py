"""Steps that raise the cost on the way are taken back where they led nowhere."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.estimation.problem.solver import SolverOptions, optimize_states
from maplab_py.progress import SILENT
from tests.support.dense import dense_problem
from tests.support.scene import Scene, corrupted


def test_more_iterations_never_give_a_higher_cost() -> None:
    start = corrupted(
        Scene(vertices=4, landmarks=20, seen_share=0.8).make(),
        np.random.default_rng(2),
        position_m=0.2,
        quaternion=0.03,
        landmark_m=0.2,
        velocity_mps=0.5,
        gyro_bias=1e-3,
        accel_bias=0.02,
        keep=0,
    )
    dense = dense_problem(start)
    costs = []
    for iterations in range(1, 7):  # the fourth step goes uphill
        problem = dense.problem()
        options = SolverOptions(num_iterations=iterations, max_uphill_steps=3)
        states, summary = optimize_states(problem, dense.states, options, SILENT)
        costs.append(sum(summary.final_costs.values()))
        assert sum(problem.linearize(states, 1e-9).costs.values()) == pytest.approx(
            costs[-1], rel=1e-9
        )
    # inertial edges are integrated anew at the states that are returned to: the cost is known better
    assert np.all(costs[1:] <= 1.05 * np.minimum.accumulate(costs)[:-1])
    assert costs[3] == pytest.approx(costs[2], rel=0.05)
    assert costs[-1] < 0.1 * costs[2]
