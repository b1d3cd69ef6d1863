"""Fixed states of a problem: the gauge of every cluster of vertices, and states without a term."""

import numpy as np

from maplab_py.array_types import I64, mask_of
from maplab_py.distinct import distinct
from maplab_py.estimation.problem import gauge
from maplab_py.estimation.problem.problem import Problem
from maplab_py.estimation.states import NODES_PER_VERTEX, ORIENTATION, POSITION, States
from maplab_py.estimation.terms import cameras, pose, prior, protocol, wheel
from maplab_py.estimation.terms.inertial import InertialTerm
from maplab_py.report import counted


def hold_unconstrained(problem: Problem, states: States) -> I64:
    """Fix the nodes without any term; return the vertices whose pose is among them."""
    num_vertices = len(states.T_G_I)
    touched = np.zeros(problem.num_nodes, dtype=np.bool_)
    if problem.visual is not None:
        seeing = distinct(_observing(problem))
        touched[NODES_PER_VERTEX * seeing + POSITION] = True
        touched[NODES_PER_VERTEX * seeing + ORIENTATION] = True
        if problem.visual.estimates_cameras:
            data = problem.visual.observations
            used = distinct(data.camera[data.inverse_sigma > 0.0])
            touched[cameras.camera_nodes(states)[used]] = True
    for term in problem.factors:
        touched[term.nodes.reshape(-1)] = True
    problem.fix(np.flatnonzero(~touched))
    return np.flatnonzero(~touched[NODES_PER_VERTEX * np.arange(num_vertices) + POSITION])


def fix_vertices(problem: Problem, vertices: I64) -> None:
    """Fix pose, velocity and biases of vertices (k,)."""
    problem.fix((NODES_PER_VERTEX * vertices[:, None] + np.arange(NODES_PER_VERTEX)).reshape(-1))


def fix_gauge(
    problem: Problem,
    states: States,
    held: I64,
    *,
    has_inertial: bool,
    has_fixed_landmarks: bool,
    fixed_vertices: I64 | None = None,
) -> str:
    """Fix the unobservable directions of each cluster and return a description.

    Args:
        problem: Where they are fixed.
        states: Present states.
        held: Vertices that nothing constrains.
        has_inertial: Inertial terms are used.
        has_fixed_landmarks: All landmarks are fixed.
        fixed_vertices: Vertices that are fixed already; they anchor their cluster.
    """
    num_vertices = len(states.T_G_I)
    labels = gauge.clusters(num_vertices, _links(problem, num_vertices))
    is_held = mask_of(num_vertices, held)
    anchored = _labels_of(labels, problem, pose.AbsolutePoseTerm)
    if any(isinstance(t, prior.PosePrior) and t.determines_poses for t in problem.factors):
        anchored |= _labels_of(labels, problem, prior.PosePrior)
    has_prior = problem.visual is not None and problem.visual.has_landmark_prior
    if has_fixed_landmarks or has_prior:
        anchored |= set(distinct(labels[_observing(problem)]).tolist())
    if fixed_vertices is not None:
        anchored |= set(distinct(labels[fixed_vertices]).tolist())
    inertial = _labels_of(labels, problem, InertialTerm) if has_inertial else set()
    scaled = _labels_with_scale(labels, problem) | _labels_of_rigs(labels, problem)
    counts = {"position and heading": 0, "pose": 0, "pose and scale": 0, "nothing": 0}
    for first in gauge.first_of_each(labels).tolist():
        label = int(labels[first])
        if is_held[first]:
            continue
        vertex = np.array([first], dtype=np.int64)
        if label in anchored:
            counts["nothing"] += 1
        elif label in inertial:
            gauge.fix_position_and_heading(problem, states, vertex)
            counts["position and heading"] += 1
        else:
            gauge.fix_pose(problem, vertex)
            members = np.flatnonzero(labels == label)
            if label in scaled or len(members) < 2:
                counts["pose"] += 1
                continue
            offset = states.T_G_I[members, 4:] - states.T_G_I[first, 4:]
            farthest = members[[int(np.argmax(np.linalg.norm(offset, axis=1)))]]
            gauge.fix_distance(problem, states, vertex, farthest)
            counts["pose and scale"] += 1
    fixed = [f"{what} of {counted(n, 'cluster')}" for what, n in counts.items() if n]
    return ", ".join(fixed) or "none"


def _links(problem: Problem, num_vertices: int) -> list[tuple[I64, I64]]:
    """Return pairs of vertices that a landmark or a factor joins."""
    links = []
    if problem.visual is not None:
        data = problem.visual.observations
        used = np.flatnonzero(data.inverse_sigma > 0.0)
        landmark, vertex = data.landmark[used], data.vertex[used].astype(np.int64)
        same = landmark[1:] == landmark[:-1]
        links.append((vertex[:-1][same], vertex[1:][same]))
    for term in problem.factors:
        vertices = _vertices_of(term, num_vertices)
        if vertices is not None:
            links.append((vertices.min(axis=1), vertices.max(axis=1)))
    return links


def _observing(problem: Problem) -> I64:
    """Return the vertex of every observation that takes part."""
    if problem.visual is None:
        return np.zeros(0, dtype=np.int64)
    data = problem.visual.observations
    return data.vertex[data.inverse_sigma > 0.0].astype(np.int64)


def _labels_of_rigs(labels: I64, problem: Problem) -> set[int]:
    """Return the clusters whose scale is observable because vertices have several cameras."""
    if problem.visual is None:
        return set()
    data = problem.visual.observations
    used = data.inverse_sigma > 0.0
    seen = np.zeros((len(labels), int(data.camera.max(initial=0)) + 1), dtype=np.bool_)
    seen[data.vertex[used], data.camera[used]] = True
    return set(np.unique(labels[seen.sum(axis=1) > 1]).tolist())


def _labels_with_scale(labels: I64, problem: Problem) -> set[int]:
    """Return the clusters with factors that know distances; wheels of unknown scale do not."""
    kinds = {type(term) for term in problem.factors} - {wheel.ScaledRelativePoseTerm}
    return _labels_of(labels, problem, *kinds)


def _vertices_of(term: protocol.FactorTerm, num_vertices: int) -> I64 | None:
    """Return the vertices (N, n) of a term; None when it touches other parameters only."""
    is_vertex = term.nodes < NODES_PER_VERTEX * num_vertices
    if not is_vertex.any():
        return None
    some = np.take_along_axis(term.nodes, is_vertex.argmax(axis=1)[:, None], axis=1)
    return np.asarray(np.where(is_vertex, term.nodes, some) // NODES_PER_VERTEX)


def _labels_of(labels: I64, problem: Problem, *kinds: type) -> set[int]:
    """Return the clusters with terms of some kinds."""
    result: set[int] = set()
    for term in problem.factors:
        vertices = _vertices_of(term, len(labels)) if isinstance(term, kinds) else None
        if vertices is not None:
            result.update(np.unique(labels[vertices]).tolist())
    return result
