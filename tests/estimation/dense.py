"""A dense reference for `Problem`: residuals by calling terms, Jacobians by central differences."""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.problem.problem import Linearization, Problem
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.protocol import FactorTerm

F64 = NDArray[np.float64]


def numeric_jacobian(residual: Callable[[States], F64], states: States, step: float = 1e-6) -> F64:
    """Differentiate a residual by all nodes (columns 3 per node)."""
    columns = []
    for k in range(3 * states.num_nodes):
        move = np.zeros(3 * states.num_nodes)
        move[k] = step
        ahead = residual(states.moved(move.reshape(-1, 3), states.p_G))
        behind = residual(states.moved(-move.reshape(-1, 3), states.p_G))
        columns.append((ahead - behind).reshape(-1) / (2.0 * step))
    return np.array(columns).T


def numeric_point_jacobian(
    residual: Callable[[States], F64], states: States, step: float = 1e-6
) -> F64:
    """Differentiate a residual by all landmarks."""
    columns = []
    for k in range(states.p_G.size):
        move = np.zeros(states.p_G.size)
        move[k] = step
        moved = [
            dataclasses.replace(states, p_G=states.p_G + sign * move.reshape(-1, 3))
            for sign in (1.0, -1.0)
        ]
        columns.append((residual(moved[0]) - residual(moved[1])).reshape(-1) / (2.0 * step))
    return np.array(columns).T


def term_jacobian(term: FactorTerm, states: States) -> F64:
    """Put a term's own Jacobians (N, m, 3 n) into one dense matrix over all nodes."""
    residual, jacobian = term.evaluate(states)
    count, size = residual.shape
    full = np.zeros((count, size, states.num_nodes, 3))
    for n in range(count):
        for place, node in enumerate(term.nodes[n]):
            full[n, :, node] += jacobian[n, :, 3 * place : 3 * place + 3]
    return full.reshape(count * size, -1)


def system_matrix(problem: Problem, linear: Linearization, damping: float) -> F64:
    """Return the damped system matrix of a problem as a dense one."""
    size = problem.num_nodes
    dense = np.zeros((size, 3, size, 3))
    rows, cols = np.unique(np.stack(problem.block_places(linear.states)), axis=1)
    for block, row, col in zip(problem.blocks(linear, rows, cols), rows, cols, strict=True):
        dense[row, :, col] = block
        if row != col:
            dense[col, :, row] = block.T
    matrix = dense.reshape(3 * size, -1)
    matrix = np.tril(matrix) + np.tril(matrix, -1).T
    clipped = np.clip(linear.diagonal, 1e-6, 1e32).reshape(-1)
    return np.asarray(matrix + damping * np.diag(clipped))


def assert_relative(jacobian: F64, wanted: F64) -> None:
    """Compare to 1e-6 of the largest entry of each row."""
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.all(np.abs(jacobian - wanted) <= 1e-6 * size)


def differences(function: Callable[[F64], F64], count: int) -> F64:
    """Return the Jacobian by central differences of fourth order."""
    columns = []
    for k in range(count):
        d = np.zeros(count)
        d[k] = 1e-3
        columns.append(
            (8 * (function(d) - function(-d)) - function(2 * d) + function(-2 * d)) / 0.012
        )
    return np.stack(columns, axis=1)
