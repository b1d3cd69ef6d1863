"""Simulated pose graphs with the structures of SE-Sync's benchmark set (Rosen et al., IJRR 2019, table 1).

Poses are chained along the odometry, as they are in the public files of a torus, a sphere and a grid.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from maplab_py.algorithms.relaxation import graph_files, robust
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError
from maplab_py.estimation.problem.gauge import connected_parts
from maplab_py.estimation.symbolic.sources import PoseError
from maplab_py.estimation.terms.pose_graph import RelativePoses, TiltPriors
from maplab_py.geometry import se3, so3
from maplab_py.interop.g2o import PoseGraph, chained_poses
from maplab_py.progress import SILENT, Progress

_SIGMA = np.repeat([0.05, 0.02], 3)
"""Standard deviations of a measurement, position [m] and orientation [rad]."""


def torus(poses: int, turns: int, seed: int) -> PoseGraph:
    """Wind a trajectory around a torus; each pose is measured from the one a turn before as well."""
    row, per_turn = np.arange(poses), poses // turns
    around, along = 2.0 * np.pi * row / per_turn, 2.0 * np.pi * row / poses
    ring_m = 10.0 + 4.0 * np.cos(around)
    p = np.column_stack([ring_m * np.cos(along), ring_m * np.sin(along), 4.0 * np.sin(around)])
    zero = np.zeros(poses)
    q = so3.multiply(
        so3.exp(np.column_stack([zero, zero, along])),
        so3.exp(np.column_stack([zero, -around, zero])),
    )
    return _measured(se3.make(q, p), _one_turn_before(row, per_turn), seed)


def sphere(poses: int, rings: int, seed: int) -> PoseGraph:
    """Wind a trajectory round a sphere of 50 m from pole to pole; neighbours on rings are measured."""
    row, per_ring = np.arange(poses), poses // rings
    yaw = 2.0 * np.pi * row / per_ring
    pitch = np.pi * (row / (poses - 1) - 0.5)
    p = 50.0 * np.column_stack(
        [np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)]
    )
    zero = np.zeros(poses)
    q = so3.multiply(
        so3.exp(np.column_stack([zero, zero, yaw])), so3.exp(np.column_stack([zero, -pitch, zero]))
    )
    return _measured(se3.make(q, p), _one_turn_before(row, per_ring), seed)


def grid(side: int, seed: int) -> PoseGraph:
    """Visit every node of a cube with `side` nodes along each edge; measure all its neighbours."""
    index = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    z, y, x = index.T
    y = np.where(z % 2 == 1, side - 1 - y, y)  # boustrophedon: neighbours in time are neighbours
    x = np.where((z * side + index[:, 1]) % 2 == 1, side - 1 - x, x)
    place = np.column_stack([x, y, z])
    code = place @ np.array([1, side, side**2])
    row_of = np.empty(side**3, dtype=np.int64)
    row_of[code] = np.arange(side**3)
    pairs = [
        np.column_stack([row_of[code[inside]], row_of[code[inside] + step]])
        for axis, step in enumerate((1, side, side**2))
        for inside in [place[:, axis] < side - 1]
    ]
    ends = np.sort(np.concatenate(pairs), axis=1)
    loops = ends[ends[:, 1] - ends[:, 0] > 1]
    T = se3.make(so3.exp(np.zeros((side**3, 3))), place.astype(np.float64))
    return _measured(T, loops, seed)


def _one_turn_before(row: I64, per_turn: int) -> I64:
    return np.column_stack([row[:-per_turn], row[per_turn:]])


def _measured(T: F64, loops: I64, seed: int) -> PoseGraph:
    """Measure odometry and loops of poses T_G_V (V, 7) with noise; loops are rows (L, 2)."""
    rng = np.random.default_rng(seed)
    count = len(T)
    row = np.arange(count)
    first = np.concatenate([row[:-1], loops[:, 0]])
    second = np.concatenate([row[1:], loops[:, 1]])
    noise = rng.normal(size=(len(first), 6)) * _SIGMA
    measured = se3.retract(se3.relative(T[first], T[second]), noise)
    odometry = slice(0, count - 1)
    chain = chained_poses(row, first[odometry], second[odometry], measured[odometry])
    information = np.tile(np.diag(_SIGMA**-2), (len(first), 1, 1))
    return PoseGraph(row, chain, first, second, measured, information, np.zeros(1, dtype=np.int64))


SIMULATED: dict[str, Callable[[], PoseGraph]] = {
    "torus": lambda: torus(5000, 50, seed=5),
    "sphere": lambda: sphere(2500, 50, seed=5),
    "grid": lambda: grid(12, seed=5),
}
"""Graphs of the benchmark by name."""


@dataclasses.dataclass(frozen=True, eq=False)
class OptimizedGraph:
    """Poses of a graph, and what became of its edges."""

    T_G_V: F64  # (V, 7)
    weight: F64  # (E,) 1 = trusted, 0 = switched off
    cost_before: float
    cost_after: float
    iterations: int


def optimize_graph(
    graph: PoseGraph, options: RelaxationOptions, *, progress: Progress = SILENT
) -> OptimizedGraph:
    """Optimise a pose graph with its own objective, sum |Log(T_measured^-1 T_A_B)|^2.

    Fixed poses stay, or the first one of each connected part where none is fixed. With robustness
    all edges but odometry may be switched off.

    Raises:
        EstimationError: The poses are not determined, or not finite.
    """
    edges = _edges(graph)
    is_plain = options.robustness == "none"
    chain = np.ones(len(edges), dtype=np.bool_) if is_plain else graph_files.is_odometry(graph)
    if np.all(chain):
        options = dataclasses.replace(options, robustness="none")
    is_free = np.ones(len(graph.id), dtype=np.bool_)
    is_free[_anchors(graph)] = False
    trajectory, loops = edges.take(np.flatnonzero(chain)), edges.take(np.flatnonzero(~chain))
    solution = robust.optimize_robustly(
        graph.T_G_V, is_free, trajectory, loops, TiltPriors.none(), options, progress
    )
    weight = np.ones(len(edges))
    weight[~chain] = solution.weight
    return OptimizedGraph(
        solution.T_G_I, weight, solution.cost_before, solution.cost_after, solution.iterations
    )


def _edges(graph: PoseGraph) -> RelativePoses:
    try:
        W = np.swapaxes(np.linalg.cholesky(graph.information), 1, 2)
    except np.linalg.LinAlgError:
        smallest = np.linalg.eigvalsh(graph.information)[:, 0]
        row = int(np.argmin(smallest))
        names = f"{graph.id[graph.first[row]]} - {graph.id[graph.second[row]]}"
        raise MapError(f"the information of edge {names} is not positive definite") from None
    return RelativePoses(graph.first, graph.second, graph.T_A_B, W, PoseError.LOGARITHM)


def _anchors(graph: PoseGraph) -> I64:
    """Return the poses that stay."""
    part = connected_parts(len(graph.id), graph.first, graph.second)
    return np.union1d(graph.fixed, part[~np.isin(part, part[graph.fixed])])
