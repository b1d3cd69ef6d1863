"""The joint step of the server: what is aligned, relaxed, anchored and shown."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.anchoring.options import AnchoringReport, MissionAlignment
from maplab_py.algorithms.cloud_registration import registration
from maplab_py.algorithms.landmarks.options import LandmarkQualityOptions
from maplab_py.algorithms.landmarks.quality import evaluate_quality
from maplab_py.errors import EstimationError, UserError
from maplab_py.server import merging, publishing
from maplab_py.server.alignments import OpenAlignments
from maplab_py.server.merging import Merger, stretches_of
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.vimap import VIMap, merge, without_resources
from tests.algorithms.cloud_registration.test_registration import ROOM, session
from tests.server.support import TWO_ROBOTS
from tests.simulation.small import simulated

OFF_M = 1.5


def map_with_a_gap(off_m: float) -> VIMap:
    """Return both robots in their true frames, the second one off by a distance."""
    data = simulated(TWO_ROBOTS)
    vi_map, _ = merge.merge_maps(*data.maps)
    rows = [
        int(np.flatnonzero((data.truth.mission_id == id_).all(axis=1))[0])
        for id_ in vi_map.missions.id
    ]
    T_G_M = vi_map.baseframes.T_G_M.copy()
    T_G_M[vi_map.missions.baseframe] = data.truth.T_G_M[rows]
    T_G_M[vi_map.missions.baseframe[1], 4] += off_m
    frames = vi_map.baseframes.replace(T_G_M=T_G_M, is_known=np.ones(2, dtype=np.bool_))
    return evaluate_quality(vi_map.replace(baseframes=frames), LandmarkQualityOptions())[0]


@pytest.mark.parametrize("off_m", [0.0, OFF_M])
def test_a_gap_is_closed_by_relaxation(off_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    relaxations: list[int] = []
    relax = merging.relax

    def counted(*arguments: Any, **named: Any) -> Any:
        relaxations.append(len(named["loop_closures"]))
        return relax(*arguments, **named)

    monkeypatch.setattr(merging, "relax", counted)
    vi_map = map_with_a_gap(off_m)
    merger = Merger(MergingOptions(), IncrementalOptions())
    merger.restore(vi_map, stretches_of(vi_map))
    moved_m = merger.optimize_jointly()
    assert len(relaxations) == (off_m > 0.0)
    assert all(relaxations)
    assert merger.vi_map is not None
    assert evaluate_map(merger.vi_map, simulated(TWO_ROBOTS).truth).ate_m < 0.1
    assert moved_m > 0.5 * off_m


AROUND = session(ROOM, SessionOptions(duration_s=24.0, turns=1.8), rate_hz=1.0)


def merger(*, lidar: bool) -> Merger:
    options = MergingOptions(enable_visual_loop_closure=False, enable_lidar_loop_closure=lidar)
    result = Merger(options, IncrementalOptions(), map_folder=Path())
    result.restore(simulated(AROUND).maps[0], [])
    return result


def test_joint_optimisations_use_clouds_where_it_is_wanted() -> None:
    truth = simulated(AROUND).truth
    without, with_clouds = merger(lidar=False), merger(lidar=True)
    for one in (without, with_clouds):
        one.optimize_jointly()
        assert one.vi_map is not None
    assert not len(without.vi_map.loop_closure_edges)
    assert len(with_clouds.vi_map.loop_closure_edges) > 10
    assert with_clouds.note == ""
    errors_m = [evaluate_map(m.vi_map, truth).ate_m for m in (without, with_clouds)]
    assert errors_m[1] < 0.8 * errors_m[0]


def test_a_map_without_clouds_and_a_missing_library_stop_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def missing() -> None:
        raise UserError("registration of clouds needs the library small_gicp: install it")

    monkeypatch.setattr(registration, "small_gicp", missing)
    server = merger(lidar=True)
    server.optimize_jointly()
    assert server.note == (
        "no clouds were registered: registration of clouds needs the library small_gicp: install it"
    )
    assert server.vi_map is not None
    server.restore(without_resources(server.vi_map, server.vi_map.resources.type >= 0), [])
    server.optimize_jointly()
    assert server.note == ""


def test_a_joint_optimisation_says_why_no_loops_were_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def close_loops(*_: object, **__: object) -> None:
        raise EstimationError("too few tracks")

    monkeypatch.setattr(merging, "close_loops", close_loops)
    server = Merger(MergingOptions(), IncrementalOptions())
    server.restore(simulated(AROUND).maps[0], [])
    server.optimize_jointly()
    assert server.note == "no loops were closed: too few tracks"


A, B, C, D = (letter * 32 for letter in "abcd")
NAMES = {id_[:8]: id_ for id_ in (A, B, C, D)}


def report(*pairs: tuple[str, str], known: str = "", verdict: str = "used") -> AnchoringReport:
    unknown = {id_[:8]: "" for pair in pairs for id_ in pair if id_ != known}
    alignments = tuple(
        MissionAlignment(f"{a[:8]} - {b[:8]}", 5, 5, 0.01, verdict) for a, b in pairs
    )
    return AnchoringReport((known[:8],), (), unknown, alignments)


def test_pairs_wait_for_one_of_their_missions() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), (B, C)), NAMES, [0, 1])
    pairs.note(report((B, C)), NAMES, [2])
    assert pairs.take([D], 5) == {}
    assert pairs.take([C], 5) == {B: {0, 1, 2}}
    assert pairs.take([C], 5) == {}
    assert pairs.take([B], 5) == {A: {0, 1}}


def test_alignments_that_do_not_hold_and_known_missions_are_not_remembered() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), verdict="3 closures agree, 4 are needed"), NAMES, [0])
    pairs.note(report((C, D), known=C), NAMES, [1])
    assert pairs.take([A, C], 5) == {}


def test_a_step_takes_as_many_as_it_may_and_a_copy_is_independent() -> None:
    pairs = OpenAlignments()
    pairs.note(report((A, B), (A, C), (A, D)), NAMES, [0])
    copy = pairs.copy()
    assert list(copy.take([A], 2)) == [B, C]
    assert list(copy.take([A], 2)) == [D]
    assert len(pairs.take([A], 5)) == 3


MAPS = [VIMap() for _ in range(4)]


def test_every_map_is_shown_without_an_interval() -> None:
    seen: list[VIMap] = []
    display = publishing.Display(seen.append, 0.0)
    for vi_map in MAPS:
        display.offer(vi_map)
    assert all(a is b for a, b in zip(seen, MAPS, strict=True))
    display.show(at_once=True)
    assert len(seen) == len(MAPS)


def test_the_latest_map_is_shown_when_its_time_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("maplab_py.server.publishing.time.monotonic", lambda: now[0])
    seen: list[VIMap] = []
    display = publishing.Display(seen.append, 10.0)
    display.offer(MAPS[0])
    display.offer(MAPS[1])
    display.offer(MAPS[2])
    now[0] += 9.9
    display.show()
    assert seen == [MAPS[0]]
    now[0] += 0.2
    display.show()
    display.show()
    assert [MAPS.index(vi_map) for vi_map in seen] == [0, 2]
    display.offer(MAPS[3])
    display.show(at_once=True)
    assert MAPS.index(seen[-1]) == 3


def test_a_deleted_map_is_not_shown() -> None:
    seen: list[VIMap] = []
    display = publishing.Display(seen.append, 0.0)
    display.offer(None)
    publishing.Display(None, 0.0).offer(MAPS[0])
    assert seen == []
