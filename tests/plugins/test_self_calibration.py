"""The self-calibration commands, through the session."""

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import checks
from maplab_py.algorithms.self_calibration.device import device_of
from maplab_py.algorithms.self_calibration.segments import database as database_file
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.session import Session
from maplab_py.console.session.status import Status
from maplab_py.console.terminal import foreground, output
from maplab_py.errors import EstimationError, UserError
from maplab_py.sensors.sensors_yaml import read_sensors
from maplab_py.storage.native import save_map
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import device, scene_map, uncalibrated

FLAGS = {
    "sc_segment_keyframes": 10,
    "sc_segments_per_group": 2,
    "sc_min_parallax_deg": 0.0,
    "sc_keep_unobservable_at_prior": True,
}


@pytest.fixture
def session() -> Session:
    session = Session()
    session.maps.add("walk", uncalibrated(scene_map(vertices=61, noise=1.0)))
    return session


def focal_px(session: Session) -> float:
    return float(device(session.vi_map)[1].cameras[0].intrinsics[0])


def test_a_dry_run_changes_nothing_and_the_command_does(session: Session, tmp_path: Path) -> None:
    database = tmp_path / "device.segments"
    before = focal_px(session)
    planned = session.run("self-calibrate", dry_run=True, database=database, **FLAGS)
    assert focal_px(session) == before
    assert not database.exists()
    done = session.run("self_calibrate", database=database, **FLAGS)
    assert done.parameters == planned.parameters
    focal = next(one for one in done.parameters if one.parameter == "camera focal length u")
    assert focal_px(session) == pytest.approx(focal.after)
    assert abs(focal_px(session) - 310.0) < abs(before - 310.0)
    assert database.is_file()


@pytest.mark.parametrize("moment", ["calibrated", "saving"])
def test_ctrl_c_leaves_no_thread_that_writes_the_database(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """Cancelled means that the database and the map are as before."""
    database = tmp_path / "device.segments"

    def interrupted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*words: Any, **flags: Any) -> Any:
            result = function(*words, **flags) if moment == "calibrated" else None
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(3.0 * foreground.SECONDS_OF_GRACE)
            return function(*words, **flags) if moment == "saving" else result

        return call

    module, name = (
        (checks, "calibrate_with_checks") if moment == "calibrated" else
        (database_file, "save_database")
    )  # fmt: skip
    monkeypatch.setattr(module, name, interrupted(getattr(module, name)))
    session.terminal = terminal = output.ConsoleTerminal()
    runner = Runner(session, terminal)
    flags = " ".join(f"--{name}={value}" for name, value in FLAGS.items())
    before = session.vi_map
    status = runner.run_text(f"self_calibrate --database={database} {flags}")
    for thread in threading.enumerate():
        if thread.name == "command self_calibrate":
            thread.join(timeout=60.0)  # an abandoned command runs on without effect
    assert status == Status.CANCELLED
    assert list(tmp_path.iterdir()) == []
    assert session.vi_map is before


def test_collect_show_prune_and_export(session: Session, tmp_path: Path) -> None:
    database = tmp_path / "device.segments"
    planned = session.run("collect_segments", database=database, dry_run=True, **FLAGS)
    assert not database.exists()
    collected = session.run("collect_segments", database=database, **FLAGS)
    assert collected.segments == planned.segments
    shown = session.run("segment_database_stats", database=database)
    assert shown.sessions == 1
    assert len(shown.segments) == collected.segments_kept
    assert {one.table: one.segments for one in shown.tables} == {
        "imu": 2,
        "camera": 2,
        "extrinsics": 2,
    }
    before = database.read_bytes()
    planned = session.run(
        "prune_segments", database=database, segments_per_group=1, dry_run=True, **FLAGS
    )
    assert database.read_bytes() == before
    pruned = session.run("prune_segments", database=database, segments_per_group=1, **FLAGS)
    assert pruned == planned
    assert pruned.segments_after < pruned.segments_before == collected.segments_kept
    session.run("export_segments", database=database, map_folder=tmp_path / "map")
    session.run("load", map_folder=tmp_path / "map")
    assert len(session.vi_map.vertices) > 10
    with pytest.raises(UserError, match="no segment"):
        session.run("prune_segments", database=database, missions="abc", **FLAGS)
    for probability in (-1.0, 0.0, 1.0, 2.0, float("nan")):
        with pytest.raises(UserError, match=r"--probability=.*: must be between 0 and 1"):
            session.run("prune_segments", database=database, probability=probability)


def test_information_is_drawn_and_written(session: Session, tmp_path: Path) -> None:
    plot, csv = tmp_path / "information.svg", tmp_path / "information.csv"
    report = session.run("evaluate_segment_information", plot=plot, csv=csv, **FLAGS)
    assert len(report.segments) == 7
    assert plot.read_text().count("<polyline") == 7
    lines = csv.read_text().splitlines()
    assert lines[0] == "mission,start_ns,end_ns,information"
    assert [float(line.split(",")[3]) for line in lines[1:]] == [one.imu for one in report.segments]


def test_calibrations_are_exported_compared_and_applied(session: Session, tmp_path: Path) -> None:
    truth = scene_map(vertices=61, noise=1.0)
    save_map(truth, tmp_path / "true")
    compared = session.run("compare_calibrations", calibration=tmp_path / "true")
    focal = next(one for one in compared.parameters if one.parameter == "camera focal length u")
    assert (focal.first, focal.second) == pytest.approx((313.0, 310.0))
    session.run("apply_calibration", calibration=tmp_path / "true")
    assert focal_px(session) == 310.0
    again = session.run("compare_calibrations", calibration=tmp_path / "true")
    assert max(abs(one.difference) for one in again.parameters) <= 1e-9
    assert again.largest_pixel_shift_px <= 1e-6
    written = session.run("export_calibration", folder=tmp_path / "out", format="maplab")
    sensors = read_sensors(written.files[0])
    np.testing.assert_allclose(
        sensors.imu(device(truth)[0].id).intrinsics.T_a, device(truth)[0].intrinsics.T_a
    )
    assert len(session.run("export_calibration", folder=tmp_path / "k", format="kalibr").files) == 2


def test_mistakes_are_explained(session: Session, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--sc_states"):
        session.run("self_calibrate", sc_states="lens")
    with pytest.raises(UserError, match="--sc_groups"):
        session.run("self_calibrate", sc_groups="imu,lens")
    with pytest.raises(UserError, match="cannot be combined with --batch"):
        session.run("self_calibrate", batch=True, database=tmp_path / "d")
    with pytest.raises(UserError, match="max_camera_shift_m"):
        session.run("self_calibrate", max_camera_shift_m=-1.0)
    with pytest.raises(UserError, match="sc_segments_per_group"):
        session.run("self_calibrate", sc_segments_per_group=0)
    (tmp_path / "notes.txt").write_text("no database")
    with pytest.raises(UserError, match="not a segment database"):
        session.run("segment_database_stats", database=tmp_path / "notes.txt")
    with pytest.raises(UserError, match="is a folder"):
        session.run("segment_database_stats", database=tmp_path)
    with pytest.raises(UserError, match="no such calibration"):
        session.run("apply_calibration", calibration=tmp_path / "nothing.yaml")
    with pytest.raises(EstimationError, match="sc_segment_keyframes"):
        session.run("collect_segments", database=tmp_path / "d", sc_segment_keyframes=1000)


def test_sessions_of_different_calibration_can_be_merged(session: Session) -> None:
    before = session.vi_map
    session.run("self_calibrate", batch=True, **FLAGS)
    calibrated = session.vi_map
    session.maps.add("again", uncalibrated(scene_map(vertices=61, noise=1.0, seed=2)))
    session.run("merge_map", map_key="walk", assign_new_ids=True)
    merged = session.vi_map
    found = [device_of(merged, np.array([row])) for row in range(2)]
    assert found[0][0] != found[1][0]
    assert found[0][1] != found[1][1]
    imus = [merged.sensors.imu(ids[0]).intrinsics for ids in found]
    assert imus[0] is None
    np.testing.assert_array_equal(imus[1].T_a, device(calibrated)[0].intrinsics.T_a)
    focal = [merged.sensors.camera_rig(ids[1]).cameras[0].intrinsics[0] for ids in found]
    assert focal == [device(before)[1].cameras[0].intrinsics[0], focal_px_of(calibrated)]
    # which of the two a calibration of both would be of is not for the program to guess
    with pytest.raises(UserError, match="map_mission_list"):
        session.run("self_calibrate", batch=True, **FLAGS)
    session.run("optvi", ba_num_iterations=2)


def focal_px_of(vi_map: VIMap) -> float:
    return float(device(vi_map)[1].cameras[0].intrinsics[0])
