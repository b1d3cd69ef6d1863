"""Which edges the preconditioner has exactly: where it has all, one iteration solves the system."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.array_types import I64
from maplab_py.estimation.codegen.kernels import residual_kernel
from maplab_py.estimation.problem.iterative import IterativeOptions, IterativeProblem
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import NODES_PER_VERTEX, States
from maplab_py.estimation.symbolic.sources import relative_pose
from maplab_py.estimation.terms.pose import RelativePoseTerm, whitening
from maplab_py.geometry import se3

VERTICES = 40
DAMPING = 1e-6


def poses(seed: int = 0) -> States:
    rng = np.random.default_rng(seed)
    T_G_I = se3.exp(rng.normal(size=(VERTICES, 6)) * [2.0, 2.0, 2.0, 0.5, 0.5, 0.5])
    zero = np.zeros((VERTICES, 3))
    return States(T_G_I, zero, zero, zero, np.zeros((0, 3)))


def edges(states: States, name: str, pairs: I64) -> RelativePoseTerm:
    """Return measured relative poses that differ from those of the states."""
    first, second = pairs.T
    rng = np.random.default_rng(1)
    T = states.T_G_I
    measured = se3.retract(
        se3.relative(T[first], T[second]), 0.1 * rng.normal(size=(len(pairs), 6))
    )
    return RelativePoseTerm(
        residual_kernel("relative_pose", relative_pose), name, first, second,
        se3.identity(len(pairs)), measured, whitening(np.tile(1e-2 * np.eye(6), (len(pairs), 1, 1))),
    )  # fmt: skip


def iterations(pairs: I64, *loops: I64) -> int:
    """Return the iterations of one exact step, checked against the factorisation."""
    states = poses()
    terms = [edges(states, "odometry", pairs), *(edges(states, "loop", loop) for loop in loops)]
    options = IterativeOptions(forcing=1e-9)
    iterative = IterativeProblem(states, None, terms, options=options)
    direct = Problem(states, None, terms)
    unused = np.arange(direct.num_nodes)
    steps = []
    for problem in (iterative, direct):
        problem.fix(unused[unused % NODES_PER_VERTEX >= 2])
        problem.fix(np.array([0, 1]))
        steps.append(problem.solve(problem.linearize(states, DAMPING), DAMPING))
    np.testing.assert_allclose(steps[0], steps[1], atol=1e-5 * np.abs(steps[1]).max())
    return iterative.linear_iterations


def chain(order: I64) -> I64:
    return np.stack([order[:-1], order[1:]], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_chains_are_exact_whatever_the_order_of_their_rows(seed: int) -> None:
    order = np.random.default_rng(seed).permutation(VERTICES)
    assert iterations(chain(order)) == 1


def test_an_edge_that_joins_two_sessions_is_exact() -> None:
    first, second = np.split(np.arange(VERTICES), 2)
    sessions = np.concatenate([chain(first), chain(second)])
    assert iterations(sessions, np.array([[3, VERTICES - 4]])) == 1


def test_edges_between_near_rows_are_exact() -> None:
    rows = np.arange(VERTICES)
    skipping = np.stack([rows[:-8], rows[8:]], axis=1)
    assert iterations(np.concatenate([chain(rows), skipping])) == 1


def test_loops_are_left_to_the_iterations() -> None:
    loops = np.array([[0, 30], [35, 5], [10, 25]])
    assert 1 < iterations(chain(np.arange(VERTICES)), loops) < 60
