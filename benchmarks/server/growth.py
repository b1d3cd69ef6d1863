"""Processor time per new submap with the size of the map.

Missions of 15 s (31 vertices, up to 100 keypoints each) walk a third of the way round blocks of a town, every
second block the other way round, so that neighbours look in the same direction in the street between
them. Joint optimisations are left out. Measured is what the server's loop does for a submap: append,
anchor, close loops, optimise, and publish the map.
"""

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.server.prepared import prepared
from maplab_py.server.merging import Merger
from maplab_py.server.options import IncrementalOptions, MergingOptions, PublishingOptions
from maplab_py.server.publishing import Publisher, pause_s
from maplab_py.simulation import scenario as sim
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap

_LATEST = 8
"""Submaps whose times are averaged."""


@dataclasses.dataclass(frozen=True)
class GrowthFigures:
    """Mean processor time per submap [s] around one number of missions."""

    missions: int
    vertices: int
    keypoints: int
    anchored: int
    steps_s: dict[str, float]
    merge_s: float
    publish_s: float  # after each submap
    served_s: float  # per submap, with publications as often as while submaps are ready
    files: int
    files_written: float  # of a publication
    exponent_merge: float  # of merge_s against the first row
    exponent: float  # of both
    exponent_served: float  # of served_s
    whole_s: float  # a publication that writes every file, once


def town(missions: int, blocks: tuple[int, int] = (4, 3)) -> SimulatedData:
    """Simulate missions in a town; neighbours in the list walk the same block."""
    sessions = []
    for number in range(missions):
        block = (number // 4) % (blocks[0] * blocks[1])
        at = (block % blocks[0], block // blocks[0])
        sessions.append(
            sim.SessionOptions(
                kind="streets",
                duration_s=15.0,
                turns=0.35,
                first_block=at,
                last_block=at,
                start_turn=(0.23 * (number % 4) + 0.07 * (number // 48)) % 1.0,
                reverse=(at[0] + at[1]) % 2 == 1,
            )
        )
    scenario = sim.Scenario(
        name="town",
        world=sim.WorldOptions(
            layout="city",
            blocks=blocks,
            room_size_m=(18.0, 14.0, 9.0),
            corridor_width_m=6.0,
            landmarks_per_room=4000,
        ),
        measurement=sim.MeasurementOptions(
            frame_rate_hz=2.0, max_keypoints=100, max_distance_m=16.0
        ),
        sessions=tuple(sessions),
    )
    return simulate(scenario)


def measure_growth(missions: int = 100) -> Iterator[str]:
    """Merge missions one by one, and yield what is to be printed."""
    data = town(missions)
    merger = Merger(MergingOptions(), IncrementalOptions())
    steps: list[dict[str, float]] = []
    first: GrowthFigures | None = None
    counts = {count for count in (10, 20, 40, 70, 100) if count <= missions}
    with tempfile.TemporaryDirectory() as folder:
        publisher = Publisher(PublishingOptions(merged_map_folder=f"{folder}/town"))
        for number, session in enumerate(data.maps, start=1):
            step = merger.add(prepared(session))
            vi_map = merger.vi_map
            assert vi_map is not None
            begin = time.process_time()
            publisher.publish(vi_map)
            publish_s = time.process_time() - begin
            written = publisher.files - publisher.files_taken_over
            steps.append({**step.seconds, "publish": publish_s, "written": written})
            if number in counts:
                figures = _figures(vi_map, publisher.files, steps[-_LATEST:], first)
                first = first or figures
                yield str(figures)


def _figures(
    vi_map: VIMap, files: int, latest: list[dict[str, float]], first: GrowthFigures | None
) -> GrowthFigures:
    mean = {name: float(np.mean([s[name] for s in latest])) for name in latest[0]}
    publish_s, written = mean.pop("publish"), mean.pop("written")
    merge_s, missions = sum(mean.values()), len(vi_map.missions)
    served_s = merge_s + publish_s / np.ceil(pause_s(publish_s) / merge_s)
    ratio = np.log(missions / first.missions) if first else 1.0
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    return GrowthFigures(
        missions,
        len(vi_map.vertices),
        len(vi_map.keypoints),
        int(known.sum()),
        {name: round(value, 3) for name, value in mean.items()},
        merge_s,
        publish_s,
        served_s,
        files,
        written,
        float(np.log(merge_s / first.merge_s) / ratio) if first else 0.0,
        float(np.log((merge_s + publish_s) / (first.merge_s + first.publish_s)) / ratio)
        if first
        else 0.0,
        float(np.log(served_s / first.served_s) / ratio) if first else 0.0,
        whole_publication_s(vi_map),
    )


def whole_publication_s(vi_map: VIMap) -> float:
    """Return the processor time of a publication that writes every file."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.process_time()
        save_map(vi_map, Path(folder) / "map")
        return time.process_time() - begin
