"""How clearly pairs of missions tell one alignment: rooms that look alike against real relations."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any
from unittest import mock

import numpy as np

from maplab_py.algorithms.loop_closure import gates, mission_pairs
from maplab_py.algorithms.loop_closure.closing import with_quality
from maplab_py.algorithms.loop_closure.detection import detect
from maplab_py.algorithms.loop_closure.mission_pairs import PairClarity, clarity_of_pairs
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.console.registry import load_registry
from maplab_py.console.session import Session
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.against_truth import joined, sessions
from tests.e2e.test_real_workflows import SUBMAPS
from tests.support.data import shared_data


def clarity(vi_map: VIMap, options: LoopClosureOptions | None = None) -> list[PairClarity]:
    """Search closures as anchoring does, and return what decides whether pairs are believed."""
    judged, _ = with_quality(vi_map)
    seen: list[PairClarity] = []
    decide = mission_pairs.without_alignment

    def listen(*arguments: Any) -> Any:
        seen.extend(clarity_of_pairs(*arguments))
        return decide(*arguments)

    with mock.patch.object(gates, "without_alignment", listen):
        detect(
            judged,
            options or LoopClosureOptions(),
            missions=np.arange(len(judged.missions)),
            only_other_missions=True,
            trust_base_frames=False,
        )
    return seen


def aliased_rooms(seed: int, rate_hz: float = 5.0) -> VIMap:
    """Return three sessions in rooms that look alike."""
    scenario = load_scenario("aliased_rooms").with_seed(seed)
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=rate_hz)
    return joined(simulate(dataclasses.replace(scenario, measurement=measurement)))


def flight() -> VIMap:
    """Return the eight EuRoC submaps as missions."""
    session = Session(load_registry())
    session.run("load_merge_all_maps", maps_folder=shared_data(SUBMAPS), assign_new_ids=True)
    return session.maps.selected.vi_map


@dataclasses.dataclass(frozen=True)
class ClarityFigures:
    """Shares of the pairs of one map that four closures or more join."""

    map: str
    pairs: int
    smallest: float
    largest: float
    shares: tuple[float, ...]


def measure(seed: int) -> Iterator[ClarityFigures]:
    """Compare rooms that look alike (to be refused) with rooms and a flight that do not."""
    maps = {
        "aliased rooms": lambda: aliased_rooms(seed),
        "four sessions": lambda: sessions(0.15, 0.3, seed=seed, rate_hz=3.0)[0],
        "EuRoC": flight,
    }
    for name, make in maps.items():
        shares = sorted(pair.share for pair in clarity(make()) if len(pair.rows) >= 4)
        yield ClarityFigures(name, len(shares), shares[0], shares[-1], tuple(shares))
