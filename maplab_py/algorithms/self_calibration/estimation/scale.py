"""Detect partitions whose metric scale is unobservable.

Where a device only rotates, nothing determines lengths. Its landmarks and the lever arm of its camera
can then shrink together during optimisation: accelerations vanish with them, no residual grows, and
once everything is small all lengths seem certain. The linearised problem at the solution does not
show this; the changed length of the path and distance of the landmarks does.

Partitions have no length in common but the lever arm. Each is tested by itself, because one that only
rotates would shrink beside others that do not, and bias the lever arm.
"""

from __future__ import annotations

import numpy as np

from maplab_py.algorithms.self_calibration.estimation.partitions import runs_of
from maplab_py.algorithms.self_calibration.estimation.problem import SegmentProblem
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.estimation.states import States
from maplab_py.vimap.ids import to_hex

_MIN_RATIO = 0.5
"""A partition has lost its scale when the length of its path and the distances of its landmarks are
both less than this part of what they were, or both more than its inverse. Rotation on the spot
reduced both by 93 to 98 %. The path alone is no criterion: where a device moves slowly most of the
path may be drift, which calibration removes."""


def path_lengths_m(T_G_I: F64, run: I64, partition: I64) -> F64:
    """Return the length (P,) of the paths in every partition, summed over its runs [m].

    Args:
        T_G_I: Poses (V, 7).
        run: Run without gap (V,) of each, in the order of time.
        partition: Partition (V,) of each, all numbers from 0 to P - 1.
    """
    step = np.linalg.norm(np.diff(T_G_I[:, 4:], axis=0), axis=1)
    step[run[1:] != run[:-1]] = 0.0
    count = int(partition.max(initial=-1)) + 1
    return np.asarray(np.bincount(partition[1:], step, minlength=count), dtype=np.float64)


def distances_m(problem: SegmentProblem, states: States, partition: I64) -> F64:
    """Return the median distance (P,) between vertices and the landmarks they observe [m].

    It is nan for a partition without landmarks.
    """
    selection, vi_map = problem.selection, problem.vi_map
    vertex = selection.rows(vi_map.keypoint_vertex[selection.keypoints])
    landmark = np.searchsorted(
        selection.landmarks, vi_map.keypoints.landmark[selection.keypoints].astype(np.int64)
    )
    distance = np.linalg.norm(states.p_G[landmark] - states.T_G_I[vertex, 4:], axis=1)
    count = int(partition.max(initial=-1)) + 1
    by_partition = [distance[partition[vertex] == k] for k in range(count)]
    return np.array([np.median(part) if len(part) else np.nan for part in by_partition])


def partitions_without_scale(
    problem: SegmentProblem, after: States, initial: SegmentProblem
) -> I64:
    """Return the partitions whose path and landmark distances were at least halved or doubled.

    Args:
        problem: What was solved.
        after: The solution.
        initial: The problem at the first states, of the same vertices.
    """
    rows = problem.selection.vertices
    run, partition = runs_of(problem.vi_map)[rows], problem.partition[rows]
    before_m, after_m = (
        np.array([path_lengths_m(states.T_G_I, run, partition), distances_m(of, states, partition)])
        for of, states in ((initial, initial.states), (problem, after))
    )
    has_shrunk = np.all(after_m < _MIN_RATIO * before_m, axis=0)
    has_grown = np.all(_MIN_RATIO * after_m > before_m, axis=0)
    return np.flatnonzero(has_shrunk | has_grown)


def vertices_outside(problem: SegmentProblem, partitions: I64) -> I64:
    """Return the vertices (rows of the map, ascending) of all other partitions."""
    rows = problem.selection.vertices
    return np.sort(rows[~np.isin(problem.partition[rows], partitions)])


def describe_partitions(problem: SegmentProblem, partitions: I64) -> tuple[str, ...]:
    """Return mission and time span, since the mission's first vertex here, of every run."""
    vi_map, rows = problem.vi_map, problem.selection.vertices
    run, time_ns = runs_of(vi_map), vi_map.vertices.timestamp_ns
    descriptions = []
    for number in np.unique(run[rows[np.isin(problem.partition[rows], partitions)]]).tolist():
        vertices = np.flatnonzero(run == number)
        mission = vi_map.vertices.mission[vertices[0]]
        start_ns = time_ns[vi_map.vertices.mission == mission].min()
        begin_s, end_s = (1e-9 * float(time_ns[k] - start_ns) for k in vertices[[0, -1]])
        name = to_hex(vi_map.missions.id[mission])[:8]
        descriptions.append(f"mission {name}, {begin_s:.1f} to {end_s:.1f} s")
    return tuple(descriptions)


def scale_refusal(problem: SegmentProblem, before: States, after: States) -> EstimationError:
    """Return the error that refuses a solution in which no partition kept its scale."""
    rows = problem.selection.vertices
    run, whole = runs_of(problem.vi_map)[rows], np.zeros(len(rows), dtype=np.int64)
    before_m, after_m = (path_lengths_m(vi_map.T_G_I, run, whole)[0] for vi_map in (before, after))
    return EstimationError(
        "the data do not determine the calibration (camera position and all other lengths: not "
        f"excited; solving took the path from {before_m:.2f} m to {after_m:.2f} m): record motion "
        "that also moves the device to and fro, with accelerations along all axes"
    )
