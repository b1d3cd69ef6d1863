"""The handheld walk, whose beginning and end are one place: found pairs, and what gap is left."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.places.brute_force import FramePairs, search
from benchmarks.places.joint_gap import JointGap, held_out_gap, merged_gap
from benchmarks.places.timing import Times, timed
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows
from tests.support.data import shared_data

TANGO = "maplab_maps/tango_handheld"
BETWEEN_S = (96.0, 118.0)
"""Pairs of the exhaustive search are 97 to 118 s apart, a few closures of the same loop 96.6 s."""
NEAR_S = 1.0
SHARED_LANDMARKS = 12
AGREE_M, AGREE_RAD = 0.3, np.deg2rad(3.0)
"""A closure finds a pair when so many of its verified landmarks are seen by the pair's other frame,
and it tells the pose that the pair tells."""


@dataclasses.dataclass(frozen=True)
class PairsFigures:
    """Pairs of an exhaustive search, and those of them that lc finds."""

    step: int  # every how manieth frame the search took
    min_inliers: int
    elsewhere: int  # verified pairs that are not the loop
    pairs: int  # of the loop: BETWEEN_S apart
    found: int  # by a closure of one frame whose landmarks the other sees, and whose pose agrees
    found_near: int  # by a closure of one frame with a vertex within NEAR_S of the other
    frames: int  # that are in some pair
    frames_closed: int  # of these, with an accepted closure
    closures: int  # all that lc accepts
    closures_elsewhere: int


def measure_pairs(step: int = 14) -> Iterator[PairsFigures]:
    """Compare all frames of a subset with each other, and see which pairs lc finds in the map.

    The walk's ends are nearly at rest for several seconds, where one closure per frame stands for
    dozens of pairs: its place is a neighbourhood, so pairs count by the landmarks that it verified.
    """
    vi_map = _load()
    frames = np.arange(0, len(vi_map.vertices), step)
    every = search(vi_map, frames, frames, later_only=True)
    closures = _accepted(vi_map)
    for min_inliers in (12, 15, 20, 30):
        yield _figures(vi_map, step, every, closures, min_inliers)


def pairs_of_loop(step: int, min_inliers: int = 20) -> PairsFigures:
    """Do the same for the two ends of the walk only."""
    vi_map = _load()
    since_s = _apart_s(vi_map, np.arange(len(vi_map.vertices)), 0)
    early, late = np.flatnonzero(since_s < 20.0)[::step], np.flatnonzero(since_s > 95.0)[::step]
    every = search(vi_map, late, early, later_only=True)
    return _figures(vi_map, step, every, _accepted(vi_map), min_inliers)


def _accepted(vi_map: VIMap) -> Closures:
    closures = search_loops(vi_map)[0].closures
    return closures.take(np.flatnonzero(closures.accepted))


def _figures(
    vi_map: VIMap, step: int, every: FramePairs, closures: Closures, min_inliers: int
) -> PairsFigures:
    apart_s = _apart_s(vi_map, closures.query_vertex, closures.place_vertex)
    pairs = every.take(every.inliers >= min_inliers)
    in_loop = _in_loop(_apart_s(vi_map, pairs.query, pairs.place))
    of_loop = pairs.take(in_loop)
    one, one_near = _found(vi_map, of_loop, closures)
    other, other_near = _found(vi_map, _turned(vi_map, of_loop), closures)
    both = np.union1d(of_loop.query, of_loop.place)
    return PairsFigures(
        step=step,
        min_inliers=min_inliers,
        elsewhere=int(np.count_nonzero(~in_loop)),
        pairs=len(of_loop),
        found=int((one | other).sum()),
        found_near=int((one_near | other_near).sum()),
        frames=len(both),
        frames_closed=int(np.isin(both, closures.query_vertex).sum()),
        closures=len(closures),
        closures_elsewhere=int(np.count_nonzero(~_in_loop(apart_s))),
    )


def _load() -> VIMap:
    from maplab_py.storage import native

    return native.load_map(shared_data(TANGO))[0]


def _apart_s(vi_map: VIMap, a: Any, b: Any) -> NDArray[np.float64]:
    time_ns = vi_map.vertices.timestamp_ns
    return np.asarray(1e-9 * np.abs(time_ns[a] - time_ns[b]))


def _in_loop(apart_s: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((apart_s >= BETWEEN_S[0]) & (apart_s <= BETWEEN_S[1]))


def _turned(vi_map: VIMap, pairs: FramePairs) -> FramePairs:
    """Return the pairs with query and place exchanged; the pose is that of the new query."""
    T_M_I = se3.compose(vi_map.vertices.T_M_I[pairs.query], pairs.T_A_B(vi_map))
    return FramePairs(pairs.place, pairs.query, pairs.matches, pairs.inliers, T_M_I)


def _found(
    vi_map: VIMap, pairs: FramePairs, closures: Closures
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which pairs (N,) a closure of their query finds: by its landmarks, and by its vertex."""
    found, near = np.zeros((2, len(pairs)), dtype=np.bool_)
    for row, (query, place) in enumerate(zip(pairs.query, pairs.place, strict=True)):
        start = vi_map.keypoint_start
        frame = np.flatnonzero(vi_map.frames.vertex == place)
        seen = vi_map.keypoints.landmark[ragged_rows(start, frame)]
        for closure in np.flatnonzero(closures.query_vertex == query):
            near[row] |= _apart_s(vi_map, closures.place_vertex[closure], place) <= NEAR_S
            verified = closures.landmark[closures.start[closure] : closures.start[closure + 1]]
            error = se3.local(pairs.T_M_I[row], closures.T_M_I[closure])
            agrees = np.linalg.norm(error[:3]) < AGREE_M and np.linalg.norm(error[3:]) < AGREE_RAD
            found[row] |= agrees and np.isin(verified, seen).sum() >= SHARED_LANDMARKS
    return found, near


@dataclasses.dataclass(frozen=True)
class GapFigures:
    """What is left of the gap after optvi, relax, lc, optvi; lengths in metres."""

    merged_landmarks: int
    closures: int  # of another search, with landmarks that were not merged
    single_median_m: float  # correction of single closures
    single_90_percent_m: float
    single_largest_m: float
    single_sigma_m: float  # what their own covariances promise (median over closures, 3-D)
    merged: JointGap  # all late observations of merged landmarks against early points
    held_out: JointGap  # all inliers of those closures together: none of them was optimised


def measure_gap() -> Iterator[GapFigures]:
    """Close the loop as a user does, and measure what is left by one pose for the whole end."""
    session = Session(load_registry())
    session.run("load", map_folder=shared_data(TANGO))
    session.run("optvi")
    session.run("set_mission_baseframe_to_known")
    session.run("relax")
    merged: Any = session.run("lc")
    session.run("optvi")
    vi_map = session.maps.selected.vi_map
    closures = _accepted(vi_map)
    correction = closures.correction_m
    variance = np.trace(closures.covariance[:, :3, :3], axis1=1, axis2=2)
    yield GapFigures(
        merged.landmarks_merged,
        len(closures),
        float(np.median(correction)),
        float(np.percentile(correction, 90)),
        float(correction.max()),
        float(np.sqrt(np.median(variance))),
        merged_gap(vi_map),
        held_out_gap(vi_map, closures),
    )


@dataclasses.dataclass(frozen=True)
class WalkFigures:
    """lc on the handheld walk as loaded, warm."""

    closures: int
    times: Times


def measure_time() -> Iterator[WalkFigures]:
    """Time lc as a command."""
    vi_map = _load()
    close_loops(vi_map)
    (_, report), times = timed(lambda: close_loops(vi_map), repeats=3)
    yield WalkFigures(report.accepted, times)
