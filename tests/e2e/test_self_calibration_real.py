"""A recorded walk with a Tango tablet: from a disturbed calibration back to where others agree."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.console.commands.registry import load_registry
from maplab_py.console.session.session import Session
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from tests.support.data import shared_data

pytestmark = pytest.mark.slow


def disturbed(vi_map: VIMap) -> VIMap:
    """2 % in focal length and distortion, 5 px in the centre, 1 degree and 1 cm in the mounting."""
    _, rig_id = device_of(vi_map)
    rig = vi_map.sensors.camera_rig(rig_id)
    camera = rig.cameras[0]
    wrong = dataclasses.replace(
        camera,
        intrinsics=camera.intrinsics * [1.02, 1.02, 1.0, 1.0] + [0.0, 0.0, 5.0, -5.0],
        distortion_parameters=camera.distortion_parameters * 1.02,
    )
    step = np.concatenate([np.full(3, 0.01), np.full(3, np.deg2rad(1.0))]) / np.sqrt(3.0)
    moved = dataclasses.replace(rig, cameras=(wrong,), T_B_C=se3.retract(rig.T_B_C, step[None, :]))
    sensors = {**vi_map.sensors.sensors, rig_id: moved}
    return vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))


def test_the_batch_returns_from_a_disturbed_calibration() -> None:
    session = Session(load_registry())
    session.run("load", map_folder=shared_data("maplab_maps/tango_handheld"))
    entry = session.maps.selected
    session.maps.update(entry.with_value(disturbed(entry.vi_map), "disturb"))
    report: Any = session.run(
        "self_calibrate",
        batch=True,
        sc_states="intrinsics,extrinsics_rotation,extrinsics_translation",
    )
    found = {one.parameter: one.after for one in report.parameters}
    # the peer's optimum
    assert found["camera focal length u"] == pytest.approx(257.2, abs=1.0)
    assert found["camera focal length v"] == pytest.approx(256.8, abs=1.0)
    assert found["camera centre u"] == pytest.approx(327.3, abs=1.0)
    assert found["camera centre v"] == pytest.approx(228.6, abs=1.0)
    assert found["camera distortion w"] == pytest.approx(0.9316, abs=1e-3)
    assert report.unobservable == ()
    assert report.chi_square_per_freedom == pytest.approx(1.0, abs=0.1)


def test_segments_of_the_calibrated_device_are_not_outdated(tmp_path: Path) -> None:
    session = Session(load_registry())
    session.run("load", map_folder=shared_data("maplab_maps/tango_handheld"))
    for command in ("relax", "lc", "optvi"):
        session.run(command)
    database = tmp_path / "tango.segments"
    session.run("self_calibrate", database=database)
    entry = session.maps.selected
    outdated = {}
    for name, vi_map in (("found", entry.vi_map), ("knocked", disturbed(entry.vi_map))):
        session.maps.update(entry.with_value(vi_map, name))
        session.run("save", map_folder=tmp_path / name)
        report: Any = session.run(
            "prune_segments",
            database=database,
            outdated=True,
            calibration=tmp_path / name,
            dry_run=True,
        )
        outdated[name] = [one.outdated for one in report.tested]
    assert len(outdated["found"]) >= 8
    assert not any(outdated["found"])
    assert all(outdated["knocked"])


def test_freeing_the_mounting_does_not_spoil_a_good_map() -> None:
    session = Session(load_registry())
    session.run("load_merge_all_submaps", maps_folder=shared_data("maplab_maps/euroc_v1_01"))
    for command in ("elq", "optvi", "lc", "optvi"):
        session.run(command)
    truth = shared_data("euroc_imu/V101.gt.csv")
    before: Any = session.run("evaluate_trajectory", ground_truth=truth, alignment="se3")
    entry = session.maps.selected
    _, rig_id = device_of(entry.vi_map)
    rig = entry.vi_map.sensors.camera_rig(rig_id)
    camera = rig.cameras[0]
    wrong = dataclasses.replace(
        camera,
        intrinsics=camera.intrinsics * [1.01, 1.01, 1.0, 1.0] + [0.0, 0.0, 4.0, -4.0],
        distortion_parameters=camera.distortion_parameters * 1.1,
    )
    sensors = {
        **entry.vi_map.sensors.sensors,
        rig_id: dataclasses.replace(rig, cameras=(wrong,)),
    }
    start = dataclasses.replace(entry.vi_map.sensors, sensors=sensors)
    session.maps.update(entry.with_value(entry.vi_map.replace(sensors=start), "disturb"))
    report: Any = session.run(
        "self_calibrate",
        batch=True,
        sc_states="intrinsics,extrinsics_rotation,extrinsics_translation",
    )
    found = {one.parameter: one for one in report.parameters}
    assert found["camera focal length u"].after == pytest.approx(459.7, abs=1.0)
    assert found["camera focal length v"].after == pytest.approx(458.5, abs=1.0)
    # these images would move the camera by 4 cm: decision 18
    assert found["camera position z"].verdict.startswith("kept: the data would move the camera")
    session.run("optvi")
    after: Any = session.run("evaluate_trajectory", ground_truth=truth, alignment="se3")
    assert after.ape_m.rmse <= before.ape_m.rmse
