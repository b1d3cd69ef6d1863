"""Four simulated sessions with noisy descriptors: precision and recall of closures, and time."""

import dataclasses
import time
from collections.abc import Iterator

from benchmarks.places.timing import Times, timed
from maplab_py.algorithms.loop_closure.workflow import close_loops, search_loops
from tests.algorithms.loop_closure.against_truth import score, sessions
from tests.support.machine import slowness

RATE_HZ, DURATION_S, LONG_S = 10.0, 60.0, 120.0


@dataclasses.dataclass(frozen=True)
class SessionsFigures:
    """Closures of four sessions against the truth."""

    seed: int
    flips: float  # part of all bits
    turnover: float  # part of the landmarks that only one session knows
    vertices: int
    keypoints: int
    accepted: int
    precision: float  # within 0.5 m and 5 deg
    recall: float  # of the vertices with 20 landmarks in common with another one
    closable: int
    search_s: float  # processor time of the search
    slowness: float  # of the machine meanwhile


def measure(seed: int) -> Iterator[SessionsFigures]:
    """Search the hard and the easy case of one seed."""
    for flips, turnover in ((0.15, 0.3), (0.05, 0.0)):
        vi_map, truth = sessions(flips, turnover, seed=seed, rate_hz=RATE_HZ, duration_s=DURATION_S)
        before, begin = slowness(), time.process_time()
        search, _ = search_loops(vi_map)
        search_s = time.process_time() - begin
        result = score(vi_map, truth, search.closures)
        yield SessionsFigures(
            seed, flips, turnover, len(vi_map.vertices), len(vi_map.keypoints), result.accepted,
            result.precision, result.recall, result.closable, search_s,
            (before + slowness()) / 2,
        )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class LongSessionsFigures:
    """lc on four sessions of two minutes."""

    seed: int
    vertices: int
    keypoints: int
    merged: int
    times: Times


def measure_long(seed: int) -> LongSessionsFigures:
    """Time lc (search and merge) as it runs in a console where it has run before."""
    vi_map, _ = sessions(0.05, 0.0, seed=seed, rate_hz=RATE_HZ, duration_s=LONG_S)
    close_loops(sessions(0.05, 0.0, seed=seed, rate_hz=2.0, duration_s=20.0)[0])  # compiles
    (_, report), times = timed(lambda: close_loops(vi_map), repeats=2)
    return LongSessionsFigures(
        seed, len(vi_map.vertices), len(vi_map.keypoints), report.landmarks_merged, times
    )
