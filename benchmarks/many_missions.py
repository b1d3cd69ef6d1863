"""Time of aam and lc against the number of missions of one place.

Run it by `python -m benchmarks.many_missions [NUMBER ...]`; without numbers 10, 20 and 40.

Every mission walks about the same room for some seconds. The exponent is the slope of the logarithm
of processor time between the smallest and the largest number of missions.
"""

import dataclasses
import sys
import time
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.against_truth import joined

DURATION_S, RATE_HZ, KEYPOINTS = 15.0, 2.0, 120


@dataclasses.dataclass(frozen=True)
class MissionsFigures:
    """Time of one number of missions."""

    missions: int
    vertices: int
    keypoints: int
    anchored: int
    aam_s: float  # processor time
    lc_s: float
    merged: int
    exponent: float  # of aam and lc together, against the first row


def missions_of_one_room(count: int, *, seed: int = 1) -> VIMap:
    """Return missions of one room in one map, the first of known base frame."""
    sessions = tuple(
        sim.SessionOptions(
            kind="room_scan",
            duration_s=DURATION_S,
            turns=0.6,
            start_turn=(0.37 * number) % 1.0,
            wall_distance_m=1.8 + 0.3 * (number % 3),
            height_m=1.4 + 0.1 * (number % 4),
        )
        for number in range(count)
    )
    scenario = sim.Scenario(
        name="many_missions",
        world=sim.WorldOptions(room_size_m=(7.0, 6.0, 3.0), landmarks_per_room=1500),
        measurement=sim.MeasurementOptions(frame_rate_hz=RATE_HZ, max_keypoints=KEYPOINTS),
        sessions=sessions,
    ).with_seed(seed)
    vi_map = joined(simulate(scenario))
    flags = np.arange(count) == 0
    known = np.isin(np.arange(len(vi_map.baseframes)), vi_map.missions.baseframe[flags])
    return vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=known))


def measure(counts: list[int]) -> Iterator[MissionsFigures]:
    """Anchor all missions and close loops, for every number of missions."""
    small = missions_of_one_room(3)
    close_loops(anchor_missions(small)[0])  # compiles
    first: tuple[int, float] | None = None
    for count in counts:
        vi_map = missions_of_one_room(count)
        begin = time.process_time()
        anchored, report = anchor_missions(vi_map)
        middle = time.process_time()
        _, closed = close_loops(anchored)
        end = time.process_time()
        first = first or (count, end - begin)
        ratio = np.log(count / first[0])
        exponent = float(np.log((end - begin) / first[1]) / ratio) if ratio > 0.0 else 0.0
        yield MissionsFigures(
            count,
            len(vi_map.vertices),
            len(vi_map.keypoints),
            len(report.anchored),
            middle - begin,
            end - middle,
            closed.landmarks_merged,
            exponent,
        )


def main() -> None:
    """Print one line for each number of missions."""
    for figures in measure([int(word) for word in sys.argv[1:]] or [10, 20, 40]):
        print(figures, flush=True)


if __name__ == "__main__":
    main()
