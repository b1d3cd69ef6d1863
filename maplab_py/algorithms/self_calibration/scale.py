"""Whether the data know how long a metre is.

A device that only turns on the spot says nothing of lengths. Its landmarks and the lever arm of its
camera can then shrink together while solving: accelerations vanish with them, nothing contradicts,
and once everything is small all lengths look certain. The linearised problem at the solution cannot
tell; that the path has become so much shorter does.

Partitions have no length in common but the lever arm, so each is judged by itself: one that only
turns would shrink beside others that do not, and draw the lever arm after it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.self_calibration.problem import SegmentProblem
from maplab_py.algorithms.self_calibration.segments import pieces
from maplab_py.errors import EstimationError
from maplab_py.estimation.states import States
from maplab_py.vimap.ids import to_hex

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_LOST = 0.5
"""A partition has lost its scale when its path and its landmarks' distances are less than this part of
what they were, or more than its inverse. Turning on the spot lost 93 to 98 % of both. The path alone
does not tell: where a device moves slowly most of it may be drift, which calibrating takes away."""


def path_lengths_m(T_G_I: F64, run: I64, partition: I64) -> F64:
    """Return the length (P,) of the paths in every partition, summed over its runs [m].

    Args:
        T_G_I: Poses (V, 7).
        run: Run without gap (V,) that each belongs to, in the order of time.
        partition: Partition (V,), all numbers from 0 to P - 1.
    """
    step = np.linalg.norm(np.diff(T_G_I[:, 4:], axis=0), axis=1)
    step[run[1:] != run[:-1]] = 0.0
    count = int(partition.max(initial=-1)) + 1
    return np.asarray(np.bincount(partition[1:], step, minlength=count), dtype=np.float64)


def distances_m(problem: SegmentProblem, states: States, partition: I64) -> F64:
    """Return the median distance (P,) from which the landmarks of every partition are seen [m].

    It is nan where no landmark is seen.
    """
    selection, vi_map = problem.posed.selection, problem.posed.vi_map
    vertex = selection.rows(vi_map.keypoint_vertex[selection.keypoints])
    landmark = np.searchsorted(
        selection.landmarks, vi_map.keypoints.landmark[selection.keypoints].astype(np.int64)
    )
    away = np.linalg.norm(states.p_G[landmark] - states.T_G_I[vertex, 4:], axis=1)
    count = int(partition.max(initial=-1)) + 1
    found = [away[partition[vertex] == one] for one in range(count)]
    return np.array([np.median(one) if len(one) else np.nan for one in found])


def partitions_without_scale(problem: SegmentProblem, after: States, begun: SegmentProblem) -> I64:
    """Return the partitions whose paths and distances solving has halved or doubled at least.

    Args:
        problem: What was solved.
        after: The solution.
        begun: The problem that solving began with, of the same vertices.
    """
    rows = problem.posed.selection.vertices
    run, partition = pieces(problem.posed.vi_map)[rows], problem.partition[rows]
    before = begun.posed.states
    known = np.array(
        [path_lengths_m(before.T_G_I, run, partition), distances_m(begun, before, partition)]
    )
    found = np.array(
        [path_lengths_m(after.T_G_I, run, partition), distances_m(problem, after, partition)]
    )
    shrunk = np.all(found < _LOST * known, axis=0)
    grown = np.all(_LOST * found > known, axis=0)
    return np.flatnonzero(shrunk | grown)


def without_partitions(problem: SegmentProblem, lost: I64) -> I64:
    """Return the vertices (rows of the map, ascending) of all other partitions."""
    rows = problem.posed.selection.vertices
    return np.sort(rows[~np.isin(problem.partition[rows], lost)])


def names_of(problem: SegmentProblem, lost: I64) -> tuple[str, ...]:
    """Say which runs some partitions are made of: mission, and time since its first vertex here."""
    vi_map, rows = problem.posed.vi_map, problem.posed.selection.vertices
    run, time_ns = pieces(vi_map), vi_map.vertices.timestamp_ns
    names = []
    for one in np.unique(run[rows[np.isin(problem.partition[rows], lost)]]).tolist():
        own = np.flatnonzero(run == one)
        mission = vi_map.vertices.mission[own[0]]
        start_ns = time_ns[vi_map.vertices.mission == mission].min()
        begin_s, end_s = (1e-9 * float(time_ns[k] - start_ns) for k in (own[0], own[-1]))
        name = to_hex(vi_map.missions.id[mission])[:8]
        names.append(f"mission {name}, {begin_s:.1f} to {end_s:.1f} s")
    return tuple(names)


def refuse_lost_scale(problem: SegmentProblem, before: States, after: States) -> None:
    """Refuse a solution no partition of which has kept its scale.

    Raises:
        EstimationError: Always; it says from what to what the path has changed.
    """
    rows = problem.posed.selection.vertices
    run, one = pieces(problem.posed.vi_map)[rows], np.zeros(len(rows), dtype=np.int64)
    known, found = (path_lengths_m(states.T_G_I, run, one)[0] for states in (before, after))
    raise EstimationError(
        "the data do not determine the calibration (camera position and all other lengths: not "
        f"excited; solving took the path from {known:.2f} m to {found:.2f} m): record motion that "
        "also moves the device to and fro, with accelerations along all axes"
    )
