"""How clearly pairs of missions tell one alignment: rooms that look alike against real relations."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.algorithms.landmarks.quality import evaluate_unknown_quality
from maplab_py.algorithms.loop_closure.ambiguity import Contest
from maplab_py.algorithms.loop_closure.detection import detect
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.simulation.scenario_file import load_scenario
from maplab_py.simulation.simulate import simulate
from maplab_py.vimap import VIMap
from tests.algorithms.loop_closure.against_truth import joined, sessions
from tests.e2e.test_real_workflows import SUBMAPS
from tests.support.data import shared_data


def clarity(vi_map: VIMap, options: LoopClosureOptions | None = None) -> list[Contest]:
    """Search closures as anchoring does, and return the alignments of all pairs of missions."""
    judged, _ = evaluate_unknown_quality(vi_map)
    detection = detect(
        judged,
        options or LoopClosureOptions(),
        missions=np.arange(len(judged.missions)),
        only_other_missions=True,
        trust_base_frames=False,
    )
    return list(detection.contests)


def share(contest: Contest) -> float:
    """Return the stretches that only a rival explains per stretch that only the best one explains.

    The largest of both missions and all rivals; it is compared with --lc_max_ambiguous_ratio.
    """
    best, *rivals = contest.pair.alignments
    shares = [0.0]
    for rival in rivals:
        for side in (0, 1):
            ours = len(np.setdiff1d(best.stretches(side), rival.stretches(side)))
            theirs = len(np.setdiff1d(rival.stretches(side), best.stretches(side)))
            shares.append(theirs / max(ours, 1))
    return max(shares)


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
    decided: int
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
        contests = [c for c in clarity(make()) if len(c.pair.rows) >= 4]
        decided = sum(c.winner >= 0 for c in contests)
        shares = sorted(share(c) for c in contests)
        yield ClarityFigures(name, len(shares), decided, shares[0], shares[-1], tuple(shares))
