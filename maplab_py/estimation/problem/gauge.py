"""Gauge: exactly the unobservable directions of a problem are fixed.

With inertial terms roll, pitch and scale are observable; position and heading of one vertex per
cluster are not (4 dimensions). With images alone orientation and scale are unobservable, too (7).
Clusters are sets of vertices that are connected by terms.
"""

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.compilation import compiled
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import NODES_PER_VERTEX, ORIENTATION, POSITION, States
from maplab_py.geometry import so3


def clusters(num_vertices: int, links: list[tuple[I64, I64]]) -> I64:
    """Label vertices (V,) that links (pairs of rows) join; labels count from 0 in row order."""
    if not links:
        return np.arange(num_vertices, dtype=np.int64)
    first, second = (np.concatenate(ends).astype(np.int64) for ends in zip(*links, strict=True))
    parts = connected_parts(num_vertices, first, second)
    return np.unique(parts, return_inverse=True)[1].astype(np.int64)


def first_of_each(labels: I64) -> I64:
    """Return the first row of every label."""
    return np.unique(labels, return_index=True)[1].astype(np.int64)


def fix_position_and_heading(problem: Problem, states: States, vertices: I64) -> None:
    """Fix position, and rotation about gravity, of vertices (k,).

    Rotations exp(d) act on the right, so heading is the part of d along gravity seen in the body;
    it is projected out. Over a step the heading then changes in second order only, which removes
    the singularity without constraining anything that terms could observe.
    """
    problem.fix(NODES_PER_VERTEX * vertices + POSITION)
    up_I = so3.rotate(so3.inverse(states.T_G_I[vertices, :4]), np.array([0.0, 0.0, 1.0]))
    problem.restrict(NODES_PER_VERTEX * vertices + ORIENTATION, null_projector(up_I))


def fix_pose(problem: Problem, vertices: I64) -> None:
    """Fix position and orientation of vertices (k,)."""
    problem.fix(NODES_PER_VERTEX * vertices + POSITION)
    problem.fix(NODES_PER_VERTEX * vertices + ORIENTATION)


def null_projector(direction: F64) -> F64:
    """Return the projectors (N, 3, 3) onto the planes normal to unit directions (N, 3)."""
    return np.asarray(np.eye(3) - direction[:, :, None] * direction[:, None, :])


def fix_distance(problem: Problem, states: States, first: I64, second: I64) -> None:
    """Fix the distance of vertices `second` (k,) from `first` (k,): the scale of a visual problem."""
    offset = states.T_G_I[second, 4:] - states.T_G_I[first, 4:]
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    apart = length[:, 0] > 0.0
    direction = offset[apart] / length[apart]
    problem.restrict(NODES_PER_VERTEX * second[apart] + POSITION, null_projector(direction))


@compiled()
def connected_parts(count, first, second):  # type: ignore[no-untyped-def]
    """Return the smallest node (count,) of each node's part, links being first (E,) to second."""
    root = np.arange(count)
    for link in range(len(first)):
        a, b = first[link], second[link]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        if a < b:
            root[b] = a
        else:
            root[a] = b
    for node in range(count):
        root[node] = root[root[node]]
    return root
