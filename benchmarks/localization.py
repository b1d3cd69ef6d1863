"""Times of localisation in a map of 30,000 landmarks; thesis table 4.2: matching 7.4, RANSAC 2.5 ms.

python -m benchmarks.localization
"""

import dataclasses
import functools
import time
from unittest import mock

import numba
import numpy as np

from maplab_py.algorithms.localization.database import database_of_map, database_of_summary
from maplab_py.algorithms.localization.localization import queries, query_vertices
from maplab_py.algorithms.localization.localizer import Localization, Localizer, Outcome
from maplab_py.algorithms.localization.options import LocalizationOptions
from maplab_py.algorithms.summary.options import SummaryMapOptions
from maplab_py.algorithms.summary.summary import make_summary_map
from maplab_py.simulation.scenario import MeasurementOptions, Scenario, SessionOptions, WorldOptions
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import LandmarkQuality, VIMap, merge
from tests.support import machine, noiseless

LANDMARKS, QUERIES, REPEATS = 30_000, 60, 4


def maps() -> tuple[VIMap, VIMap]:
    """Return a map of 30,000 landmarks and a session to be localised."""
    scenario = Scenario(
        world=WorldOptions(room_size_m=(30.0, 14.0, 3.5), landmarks_per_room=34_000),
        measurement=MeasurementOptions(frame_rate_hz=5.0, max_keypoints=300),
        sessions=(
            SessionOptions(kind="loop", duration_s=60.0, turns=1.0),
            SessionOptions(kind="loop", duration_s=60.0, turns=1.0, reverse=True),
            SessionOptions(kind="loop", duration_s=60.0, turns=1.0, look_around_rad=0.6),
            SessionOptions(kind="loop", duration_s=20.0, turns=0.4, start_turn=0.2),
        ),
    )
    scenario = dataclasses.replace(scenario, drift=noiseless.without_noise(scenario).drift)
    data = simulate(scenario)
    placed = [
        m.replace(baseframes=m.baseframes.replace(T_G_M=data.truth.T_G_M[row][None]))
        for row, m in enumerate(data.maps)
    ]
    vi_map = functools.reduce(lambda a, b: merge.merge_maps(a, b)[0], placed[:-1])
    quality = np.full(len(vi_map.landmarks), LandmarkQuality.BAD)
    longest = np.argsort(-np.diff(vi_map.observation_start), kind="stable")
    quality[longest[:LANDMARKS]] = LandmarkQuality.GOOD
    return vi_map.replace(landmarks=vi_map.landmarks.replace(quality=quality)), placed[-1]


def main() -> None:
    """Print processor times per query of both kinds of maps, with a single thread."""
    vi_map, session = maps()
    full = database_of_map(vi_map)
    summary = database_of_summary(make_summary_map(vi_map, SummaryMapOptions()))
    numba.set_num_threads(1)
    for name, database in (("full", full), ("summary", summary)):
        localizer = Localizer(database, LocalizationOptions())
        source = query_vertices(session, np.array([0]), database.projection)
        chosen = list(queries(source))[:QUERIES]
        localizer.localize(chosen[0])  # compiles
        for _ in range(REPEATS):
            factor = machine.slowness()
            with mock.patch("time.perf_counter", time.process_time):
                answers = [localizer.localize(query) for query in chosen]
            factor = 0.5 * (factor + machine.slowness())
            share = np.mean([a.outcome is Outcome.LOCALIZED for a in answers])
            keypoints = np.mean([a.keypoints for a in answers])
            print(
                f"{name}: {len(database.p_G)} landmarks, {len(database.descriptors)} observations, "
                f"{keypoints:.0f} keypoints, {100 * share:.0f} % localised; median: "
                f"{_times(answers, 1.0)}; machine {factor:.2f} times slower than ordinary: "
                f"{_times(answers, factor)}",
                flush=True,
            )


def _times(answers: list[Localization], factor: float) -> str:
    matching = 1e3 * np.median([a.matching_s for a in answers]) / factor
    ransac = 1e3 * np.median([a.ransac_s for a in answers]) / factor
    return f"matching {matching:.1f} ms, RANSAC {ransac:.1f} ms"


if __name__ == "__main__":
    main()
