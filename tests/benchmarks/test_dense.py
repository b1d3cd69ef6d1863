"""The bars of dense maps at full size: depth, meshes, poses of optvi, and the time against Open3D."""

from pathlib import Path

import pytest

from benchmarks.dense import measure
from maplab_py.simulation.scenario_file import load_scenario
from tests.support.stereo_room import StereoRoom


@pytest.mark.slow
def test_depth_and_meshes_are_within_the_bars(tmp_path: Path) -> None:
    room = StereoRoom.simulated(tmp_path / "room", load_scenario("stereo_room"))
    figures = measure(room, with_optimised=True)
    depth = figures["depth stereo"]
    assert depth.median_relative <= 0.015
    assert depth.off_by_3_px <= 0.01
    assert depth.fill >= 0.95
    truth = figures["mesh of true depth"]
    assert truth.mean_mm <= 1.5
    assert truth.p90_mm <= 1.5
    assert truth.off_by_10_cm <= 0.001
    stereo, optimised = figures["mesh stereo"], figures["mesh with the poses of optvi"]
    assert stereo.mean_mm <= 18.0
    assert stereo.p90_mm <= 34.0
    assert stereo.off_by_10_cm <= 0.009
    assert stereo.within_5_cm >= 0.88
    assert optimised.mean_mm <= 1.3 * stereo.mean_mm
    assert optimised.p90_mm <= 1.3 * stereo.p90_mm
    integration = figures["integration"]
    if "Open3D" in integration:
        ratio = integration["maplab-py"].cpu_ms / integration["Open3D"].cpu_ms
        assert ratio <= 0.7
        assert integration["maplab-py"].megabytes <= 1.2 * integration["Open3D"].megabytes
