"""Processor time per new submap with the size of the map.

Missions of 15 s (31 vertices, up to 100 keypoints each) walk a third of the way round blocks of a
town; each overlaps some of the others. Joint optimisations are left out. A step is everything that the
server's loop does for a submap: append, anchor, close loops, optimise, and publish the whole map.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.server.merging import Merger
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import (
    MeasurementOptions,
    Scenario,
    SessionOptions,
    WorldOptions,
)
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.storage.native import save_map
from tests.benchmarks.server.prepared import prepared

_AROUND = 5
"""Submaps on both sides of a size whose times are averaged."""


@dataclasses.dataclass(frozen=True)
class GrowthFigures:
    """Mean processor time per submap [s] around one number of missions."""

    missions: int
    vertices: int
    keypoints: int
    steps_s: dict[str, float]
    merge_s: float
    with_publishing_s: float
    exponent_merge: float  # against the first row
    exponent: float


def town(missions: int, blocks: tuple[int, int] = (4, 3)) -> SimulatedData:
    """Simulate missions in a town; neighbours in the list walk the same block."""
    sessions = []
    for number in range(missions):
        block = (number // 4) % (blocks[0] * blocks[1])
        at = (block % blocks[0], block // blocks[0])
        sessions.append(
            SessionOptions(
                kind="streets",
                duration_s=15.0,
                turns=0.35,
                first_block=at,
                last_block=at,
                start_turn=(0.23 * (number % 4) + 0.07 * (number // 48)) % 1.0,
            )
        )
    scenario = Scenario(
        name="town",
        world=WorldOptions(
            layout="city",
            blocks=blocks,
            room_size_m=(18.0, 14.0, 9.0),
            corridor_width_m=6.0,
            landmarks_per_room=4000,
        ),
        measurement=MeasurementOptions(frame_rate_hz=2.0, max_keypoints=100, max_distance_m=16.0),
        sessions=tuple(sessions),
    )
    return simulate(scenario)


def measure_growth(missions: int = 100) -> Iterator[str]:
    """Merge missions one by one, and yield what is to be printed."""
    data = town(missions)
    merger = Merger(MergingOptions(), IncrementalOptions())
    steps: list[dict[str, float]] = []
    sizes: list[tuple[int, int]] = []
    anchored = 1
    with tempfile.TemporaryDirectory() as folder:
        for vi_map in data.maps:
            step = merger.add(prepared(vi_map))
            anchored += len(step.anchored)
            begin = time.process_time()
            assert merger.vi_map is not None
            save_map(merger.vi_map, Path(folder) / "map", force=True)
            steps.append({**step.seconds, "publish": time.process_time() - begin})
            sizes.append((len(merger.vi_map.vertices), len(merger.vi_map.keypoints)))
    first: tuple[int, float, float] | None = None
    for count in [c for c in (10, 20, 40, 70, 100, missions) if c <= missions]:
        around = steps[max(1, count - _AROUND) : count + _AROUND]
        mean = {name: float(np.mean([s[name] for s in around])) for name in around[0]}
        whole = sum(mean.values())
        merge = whole - mean["publish"]
        first = first or (count, merge, whole)
        ratio = np.log(count / first[0]) or 1.0
        exponents = np.log(merge / first[1]) / ratio, np.log(whole / first[2]) / ratio
        rounded = {name: round(value, 3) for name, value in mean.items()}
        yield str(GrowthFigures(count, *sizes[count - 1], rounded, merge, whole, *exponents))
    assert merger.vi_map is not None
    yield f"{anchored} of {missions} missions anchored, {evaluate_map(merger.vi_map, data.truth).ate_m:.3f} m"
    merger.optimize_jointly()
    errors = evaluate_map(merger.vi_map, data.truth)
    yield f"after a joint optimisation {errors.ate_m:.3f} m, {errors.false_merges} false merges"
