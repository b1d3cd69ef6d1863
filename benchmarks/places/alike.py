"""Two rooms that look alike with a corridor between them: sessions that visit both, or one of them.

Sessions that visit both are to be anchored, and landmarks of the two rooms must not be merged. Of a
session that visits one room nothing tells which it is: it is to stay where it is.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from benchmarks.places.aliased import farthest_m, merges_of_strangers, wrong_closures, wrong_merges
from maplab_py.algorithms.anchoring.anchoring import anchor_missions
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.workflow import close_loops
from maplab_py.algorithms.relaxation.options import RelaxationOptions
from maplab_py.algorithms.relaxation.relaxation import relax_over_loops
from maplab_py.algorithms.vi_optimization.optimization import optimize
from maplab_py.algorithms.vi_optimization.options import VIOptimizationOptions
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import SimulatedData, simulate
from maplab_py.simulation.truth import Truth
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.against_truth import joined

WRONG_M = 2.0
"""An anchored mission farther from its place is wrong; the rooms are 14 m apart."""
RATE_HZ = 2.0
"""Half the rate of the scenario: forty workflows are run."""
BOTH, ONE = (0, 1, 2), (0, 3, 4)
"""Sessions of the scenario that visit both rooms, and one of these with two that visit one each."""


@dataclasses.dataclass(frozen=True)
class AlikeFigures:
    """What became of the sessions of one seed."""

    visits: str  # both, one
    seed: int
    known: int  # the mission that was known
    anchored: int
    expected: int
    farthest_m: float
    wrong: bool  # an anchored mission is farther than WRONG_M from its place
    accepted: int  # closures of lc after relax
    accepted_wrong: int
    merges: int
    wrong_merges: int  # tracks of points more than 0.5 m apart
    of_strangers: int  # tracks that show other points than the rest of their landmark
    wrong_after_optvi: int  # of these, still merged after optvi


def recorded(seed: int, sessions: tuple[int, ...], rate_hz: float = RATE_HZ) -> SimulatedData:
    """Simulate some of the sessions."""
    scenario = load_scenario("two_alike_rooms").with_seed(seed)
    measurement = dataclasses.replace(scenario.measurement, frame_rate_hz=rate_hz)
    chosen = tuple(scenario.sessions[i] for i in sessions)
    return simulate(dataclasses.replace(scenario, sessions=chosen, measurement=measurement))


def with_known(vi_map: VIMap, mission: int) -> VIMap:
    """Return the map with the base frame of one mission known."""
    flags = np.arange(len(vi_map.baseframes)) == vi_map.missions.baseframe[mission]
    return vi_map.replace(baseframes=vi_map.baseframes.replace(is_known=flags))


def measure(seed: int) -> Iterator[AlikeFigures]:
    """Anchor, relax and close loops, for sessions that visit both rooms and for such that do not.

    Where nothing is anchored nothing can be merged between sessions: there the figures end.
    """
    for visits, sessions in (("both", BOTH), ("one", ONE)):
        data = recorded(seed, sessions)
        known = seed % len(sessions)
        anchored, report = anchor_missions(with_known(joined(data), known))
        away_m = farthest_m(anchored, data.truth, known)
        merging = _merged(anchored, data.truth) if report.anchored else (0, 0, 0, 0, 0, 0)
        yield AlikeFigures(
            visits,
            seed,
            known,
            len(report.anchored),
            len(sessions) - 1 if visits == "both" else 0,
            away_m,
            away_m > WRONG_M,
            *merging,
        )


def _merged(anchored: VIMap, truth: Truth) -> tuple[int, int, int, int, int, int]:
    """Relax and close loops; return the last six figures."""
    relaxed, _, _ = relax_over_loops(anchored, RelaxationOptions(), LoopClosureOptions())
    closed, _ = close_loops(relaxed)
    merges, merged_wrong = wrong_merges(closed, truth)
    remaining = merged_wrong
    if merged_wrong:
        optimised, _ = optimize(closed, VIOptimizationOptions())
        remaining = wrong_merges(optimised, truth)[1]
    strangers = merges_of_strangers(closed, truth)
    return (*wrong_closures(closed, truth), merges, merged_wrong, strangers, remaining)
