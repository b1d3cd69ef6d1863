"""Loops between the clouds of robots, in joint optimisations of the server."""

from __future__ import annotations

from pathlib import Path

import pytest

from maplab_py.algorithms.cloud_registration import registration
from maplab_py.errors import UserError
from maplab_py.server.merging import Merger
from maplab_py.server.options import IncrementalOptions, MergingOptions
from maplab_py.simulation.evaluation import evaluate_map
from maplab_py.simulation.scenario import SessionOptions
from maplab_py.vimap.resource_queries import without_resources
from tests.algorithms.cloud_registration.clouds import ROOM, session
from tests.simulation.small import simulated

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
