"""The process beside an odometry: segments, database, contradictions, proposals; also when it is killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.segments.database import (
    load_database,
    locked_database,
    read_calibration,
)
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.child_processes import Service
from maplab_py.errors import FlagError
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.online_calibration.process import OPTIONS, DeviceCalibration, Finish, Opening, Piece
from maplab_py.sensors.calibration_transfer import only_device
from maplab_py.simulation.scenario import MotionOptions
from maplab_py.simulation.simulate import simulate
from tests.online_calibration.recorded import device_scenario, pieces, session


def opening(path: Path, device: object, **options: object) -> Opening:
    chosen = OnlineCalibrationOptions(is_on=True, database=path, **options)  # type: ignore[arg-type]
    return Opening(chosen, device)  # type: ignore[arg-type]


def test_segments_are_kept_once_however_often_their_recording_is_read(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    device, segments = pieces(session())
    for name in ("first run", "again, with other ids"):
        calibration = DeviceCalibration(opening(path, device))
        for piece in segments:
            calibration.answer(Piece(name, piece.recorded))
        status = calibration.answer(Finish())
        assert status.problem == ""
        assert status.evaluated == status.kept == len(segments) == 3
    kept = load_database(path)
    assert len(kept) == 3
    assert len(kept.vi_map.missions) == 1
    # the saved map of the same recording replaces them, too
    again, _ = collect(session(), OPTIONS, kept)
    assert {record.mission for record in again.records}.isdisjoint(
        record.mission for record in kept.records
    )
    assert len(again) == 3
    # a right calibration is neither contradicted nor proposed anew
    assert status.contradiction is None
    assert not (tmp_path / "device.segments.proposal.yaml").exists()


def test_a_wrong_scale_is_found_and_a_calibration_proposed(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    device, segments = pieces(session(gyro_scale=1.02))
    options = opening(path, device)
    calibration = DeviceCalibration(options)
    statuses = [calibration.answer(piece) for piece in segments]
    assert statuses[0].contradiction is None  # a single segment may be an accident
    found = statuses[1].contradiction
    assert found is not None
    assert found.family == "gyroscope scale"
    assert found.since_ns == int(segments[0].recorded.states[0].time_ns[0])
    assert "more segments needed" in statuses[1].missing
    status = calibration.answer(Finish())
    assert status.proposal is not None
    scales = [
        e
        for e in status.proposal.parameters
        if e.parameter.startswith("gyroscope") and "scale" in e.parameter
    ]
    for estimate in scales:
        assert abs(estimate.after - 1.02) < 5.0 * estimate.sigma < 0.02
    sensors = read_calibration(options.options.proposal)
    imu = sensors.imu(only_device(sensors).imu)
    assert imu.intrinsics is not None
    np.testing.assert_allclose(np.diag(imu.intrinsics.T_g), [e.after for e in scales], atol=1e-9)
    assert "sigma)" in options.options.proposal.read_text().splitlines()[1]


def test_a_device_at_rest_says_nothing(tmp_path: Path) -> None:
    rest = MotionOptions(kind="stationary", duration_s=8.1)
    device, segments = pieces(simulate(device_scenario(rest)).maps[0])
    calibration = DeviceCalibration(opening(tmp_path / "device.segments", device))
    for piece in segments:
        calibration.answer(piece)
    status = calibration.answer(Finish())
    assert status.evaluated == len(segments) == 2
    assert status.problem == ""
    assert status.contradiction is None


def test_a_process_killed_at_any_time_leaves_a_whole_database(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    device, segments = pieces(session())
    first = DeviceCalibration(opening(path, device))
    first.answer(segments[0])
    first.answer(Finish())
    before = path.read_bytes()
    service = Service("maplab_py.online_calibration.child")
    service.ask(opening(path, device))
    process = service._process
    thread = threading.Thread(target=lambda: _ask_in_vain(service, segments[1]))
    thread.start()
    time.sleep(0.3)
    os.kill(process.pid, signal.SIGKILL)
    thread.join()
    assert path.read_bytes() == before
    with locked_database(path):  # nobody holds it any more
        assert len(load_database(path)) == 1
    assert sorted(file.name for file in tmp_path.iterdir()) == [path.name]


def _ask_in_vain(service: Service, piece: Piece) -> None:
    with pytest.raises(Exception, match="ended"):
        service.ask(piece)


def test_two_processes_lose_no_segment(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    kept = []
    for seed in (1, 2):
        device, segments = pieces(session(seed=seed))
        calibration = DeviceCalibration(opening(path, device))  # neither has seen the other's
        kept.append((calibration, segments[:1]))
    for calibration, segments in kept:
        for piece in segments:
            calibration.answer(piece)
    threads = [threading.Thread(target=c.answer, args=(Finish(),)) for c, _ in kept]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(load_database(path)) == 2


def test_flags_that_need_another_are_refused() -> None:
    with pytest.raises(FlagError, match="--self_calibrate needs the device's --sc_database=FILE"):
        OnlineCalibrationOptions(is_on=True)
    with pytest.raises(FlagError, match="--sc_apply needs --self_calibrate"):
        OnlineCalibrationOptions(apply="next_start")
