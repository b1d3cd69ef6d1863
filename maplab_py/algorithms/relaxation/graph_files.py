"""Pose graphs of other programs: optimise them as they are, or turn them into maps and back."""

import dataclasses
import hashlib
from typing import Any

import numpy as np

from maplab_py.algorithms.relaxation import map_edges
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.array_types import F64, U64, Mask, NDArray, mask_of
from maplab_py.errors import MapError
from maplab_py.geometry import se3, so3
from maplab_py.interop.g2o import PoseGraph
from maplab_py.vimap import (
    Backbone,
    BaseFrames,
    LoopClosureEdges,
    Missions,
    TransformationEdges,
    Vertices,
    VIMap,
)
from maplab_py.vimap.ids import random_ids

_ROBOT_SHIFT = 56
"""Ids above 2^56 are a robot's letter and a number (GTSAM's symbols)."""
_MOST_ROBOTS = 256 - ord("a")
_STEP_NS = 1_000_000_000


def is_odometry(graph: PoseGraph) -> Mask:
    """Return which edges (E,) join a pose with the next one of the same robot; first of each pair.

    The next pose is that of the next id in the file: ids may have gaps, and edges may point backwards.
    """
    before = np.minimum(graph.first, graph.second)
    robot = graph.id.astype(np.uint64) >> np.uint64(_ROBOT_SHIFT)
    chain = np.abs(graph.second - graph.first) == 1
    chain &= robot[graph.first] == robot[graph.second]
    _, earliest = np.unique(np.where(chain, before, -1), return_index=True)
    is_first = mask_of(len(chain), earliest)
    return np.asarray(chain & is_first)


def _turned(graph: PoseGraph, rows: Mask) -> PoseGraph:
    """Return the graph with some edges (E,) from B to A in place of A to B.

    The error of T_B_A is -Ad(T_A_B) times that of T_A_B.
    """
    T_A_B, information = np.array(graph.T_A_B), np.array(graph.information)
    T_A_B[rows] = se3.inverse(T_A_B[rows])
    R = so3.to_matrix(T_A_B[rows, :4])
    adjoint = np.zeros((len(R), 6, 6))
    adjoint[:, :3, :3] = adjoint[:, 3:, 3:] = R
    adjoint[:, :3, 3:] = so3.skew(T_A_B[rows, 4:]) @ R
    information[rows] = np.swapaxes(adjoint, 1, 2) @ information[rows] @ adjoint
    first = np.where(rows, graph.second, graph.first)
    second = np.where(rows, graph.first, graph.second)
    return dataclasses.replace(
        graph, first=first, second=second, T_A_B=T_A_B, information=information
    )


def map_of_graph(graph: PoseGraph) -> VIMap:
    """Return a map: odometry along each robot, every other edge a loop closure.

    A robot's poses are one mission as far as odometry joins them.
    Vertices lie one second apart, as the format has no times. Their ids end in those of the file.
    """
    content = hashlib.blake2b(graph.T_G_V.tobytes() + graph.T_A_B.tobytes(), digest_size=16)
    rng = np.random.default_rng(int.from_bytes(content.digest(), "little"))
    chain, vertices, ids = is_odometry(graph), len(graph.id), graph.id.astype(np.uint64)
    graph = _turned(graph, chain & (graph.first > graph.second))
    follows = mask_of(vertices, graph.second[chain])
    first = np.flatnonzero(~follows)
    mission, count = np.cumsum(~follows) - 1, len(first)
    covariance = _split_covariance(np.linalg.inv(graph.information), graph.T_A_B)
    odometry, loops = np.flatnonzero(chain), np.flatnonzero(~chain)
    return VIMap(
        missions=Missions.filled(
            count,
            id=random_ids(count, rng),
            baseframe=np.arange(count),
            root_vertex=first,
            backbone=np.full(count, Backbone.ODOMETRY),
        ),
        baseframes=BaseFrames.filled(
            count, id=random_ids(count, rng), is_known=np.ones(count, dtype=np.bool_)
        ),
        vertices=Vertices.filled(
            vertices,
            id=np.stack([np.repeat(random_ids(1, rng)[:, 0], vertices), ids], axis=1),
            mission=mission,
            T_M_I=graph.T_G_V,
            timestamp_ns=np.arange(vertices) * _STEP_NS,
        ),
        transformation_edges=TransformationEdges.filled(
            len(odometry),
            id=random_ids(len(odometry), rng),
            from_vertex=graph.first[odometry],
            to_vertex=graph.second[odometry],
            T_A_B=graph.T_A_B[odometry],
            covariance=covariance[odometry],
        ),
        loop_closure_edges=LoopClosureEdges.filled(
            len(loops),
            id=random_ids(len(loops), rng),
            from_vertex=graph.first[loops],
            to_vertex=graph.second[loops],
            T_A_B=graph.T_A_B[loops],
            covariance=covariance[loops],
        ),
    )


def _split_covariance(covariance: NDArray[Any], T_A_B: F64, *, back: bool = False) -> F64:
    """Turn the position part of covariances (N, 6, 6) from B to A (or back), to first order."""
    R = so3.to_matrix(T_A_B[:, :4])
    turn = np.tile(np.eye(6), (len(R), 1, 1))
    turn[:, :3, :3] = np.swapaxes(R, 1, 2) if back else R
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def graph_of_map(vi_map: VIMap, options: RelaxationOptions) -> PoseGraph:
    """Return the pose graph that `relax` works on: trajectories with their drift, loop closures."""
    closures = vi_map.loop_closure_edges
    as_given = map_edges.has_odometry_backbone(vi_map)[closures.from_vertex]
    loops = map_edges.loop_edges(closures, options, as_given=as_given)
    parts = map_edges.trajectory_edges(vi_map, options).followed_by(loops)
    W = parts.sqrt_information
    covariance = np.linalg.inv(np.swapaxes(W, 1, 2) @ W)
    back = _split_covariance(covariance, parts.T_A_B, back=True)
    information = np.asarray(np.linalg.inv(back), dtype=np.float64)
    return PoseGraph(
        id=_graph_ids(vi_map),
        T_G_V=vi_map.T_G_I,
        first=parts.from_vertex,
        second=parts.to_vertex,
        T_A_B=parts.T_A_B,
        information=0.5 * (information + np.swapaxes(information, 1, 2)),
        fixed=np.zeros(0, dtype=np.int64),
    )


def _graph_ids(vi_map: VIMap) -> U64:
    """Return an id of each vertex: that of the file which the map was made of, else its place.

    Raises:
        MapError: There are more missions than letters for robots.
    """
    given = vi_map.vertices.id
    if len(given) > 1 and np.all(given[:, 0] == given[0, 0]) and np.all(np.diff(given[:, 1]) > 0):
        return np.asarray(given[:, 1])
    robot = vi_map.vertices.mission
    ids = (np.arange(len(robot)) - vi_map.vertex_start[robot]).astype(np.uint64)
    if len(vi_map.missions) > _MOST_ROBOTS:
        raise MapError(
            f"g2o's ids have room for {_MOST_ROBOTS} robots, the map has {len(vi_map.missions)} missions: "
            "export parts of it"
        )
    if len(vi_map.missions) > 1:
        ids += (robot.astype(np.uint64) + np.uint64(ord("a"))) << np.uint64(_ROBOT_SHIFT)
    return np.asarray(ids)
