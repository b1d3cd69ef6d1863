"""Sessions in the streets of a city, and their truth, on disk.

The city grows with the number of sessions, so that each street is walked by as many, about five, as in
the map of Zurich's old town (Schneider 2019, paper II, 4.4). Walks go round two to six blocks.
"""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from maplab_py.simulation import scenario_file, simulate
from maplab_py.simulation.scenario import Scenario, SessionOptions
from maplab_py.simulation.truth import Truth
from maplab_py.storage.native import save_map

DURATION_S = 200.0
LANDMARKS_PER_BLOCK = 8000
_SIZES = ((3, 2), (2, 2), (2, 3), (3, 1), (1, 4), (4, 1), (1, 3))
"""Columns and rows of the blocks that the sessions walk round: 1.0 to 1.3 m/s."""
_WALKS = 11
"""One of so many walks goes clockwise: who walks a street the other way sees other facades, and without such
walks a large city falls into parts."""
_PLASTIC = 1.32471795724474602596
"""Its powers give the most even points of a plane (the R2 sequence of M. Roberts)."""


def city_scenario(missions: int, *, seed: int = 1, duration_s: float = DURATION_S) -> Scenario:
    """Return the scenario of a number of missions, about 100 observations in each image."""
    base = scenario_file.load_scenario("city").with_seed(seed)
    side = max(3, round(np.sqrt(missions)))
    world = dataclasses.replace(
        base.world, blocks=(side, side), landmarks_per_room=LANDMARKS_PER_BLOCK
    )
    sessions = tuple(_session(number, side, duration_s) for number in range(missions))
    return dataclasses.replace(base, name=f"city_{missions}", world=world, sessions=sessions)


def _session(number: int, side: int, duration_s: float) -> SessionOptions:
    """Return a walk round some blocks; the walks are spread evenly over the city."""
    size = np.minimum(_SIZES[number % len(_SIZES)], side)
    even = np.mod(0.5 + (number + 1) / np.array([_PLASTIC, _PLASTIC**2]), 1.0)
    first = np.floor(even * (side - size + 1)).astype(int)
    last = first + size - 1
    turns = 1.05 * duration_s / DURATION_S
    start = float(np.mod(0.38 * number, 1.0))
    return SessionOptions(
        kind="streets",
        duration_s=duration_s,
        turns=turns,
        start_turn=start,
        reverse=number % _WALKS == _WALKS - 1,
        first_block=(int(first[0]), int(first[1])),
        last_block=(int(last[0]), int(last[1])),
    )


def write_sessions(scenario: Scenario, folder: Path, workers: int) -> list[Path]:
    """Simulate the sessions that are not in the folder yet, each by itself, and return their maps."""
    count = len(scenario.sessions)
    missing = [n for n in range(count) if not _truth_file(folder, n).is_file()]
    if missing:
        folder.mkdir(parents=True, exist_ok=True)
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            shares = [missing[first::workers] for first in range(workers)]
            for done in [pool.submit(_write, scenario, folder, share) for share in shares if share]:
                done.result()
    return [_map_folder(folder, number) for number in range(count)]


def read_truth(folder: Path, count: int) -> Truth:
    """Return the truth of all sessions in a folder."""
    return Truth.concatenate([Truth.load(_truth_file(folder, number)) for number in range(count)])


def _write(scenario: Scenario, folder: Path, numbers: list[int]) -> None:
    simulator = simulate.SessionSimulator(scenario)
    for number in numbers:
        session = simulator.session(number)
        save_map(session.vi_map, _map_folder(folder, number), overwrite=True)
        _without_points(session.truth, number).save(_truth_file(folder, number))


def _without_points(truth: Truth, number: int) -> Truth:
    """Return a truth without the world's points, which the first session's has."""
    if number == 0:
        return truth
    none = {name: getattr(truth, name)[:0] for name in ("point_G", "point_look", "point_moving")}
    return dataclasses.replace(truth, **none)


def _map_folder(folder: Path, number: int) -> Path:
    return folder / "maps" / f"session_{number:03d}"


def _truth_file(folder: Path, number: int) -> Path:
    return folder / "truth" / f"session_{number:03d}.npz"


def sizes(maps: list[Path]) -> Iterator[tuple[int, int]]:
    """Yield the numbers of vertices and of observations of maps."""
    from maplab_py.storage.native import load_map

    for folder in maps:
        vi_map, _ = load_map(folder)
        yield len(vi_map.vertices), int(np.count_nonzero(vi_map.keypoints.landmark >= 0))
