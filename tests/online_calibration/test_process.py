"""The process beside an odometry: segments, database, contradictions, proposals; also when it is killed."""

import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration.segments import selection
from maplab_py.algorithms.self_calibration.segments.database import (
    load_database,
    locked_database,
    read_calibration,
)
from maplab_py.child_processes import Service, ServiceEnded
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
    again, _ = selection.collect(session(), OPTIONS, kept)
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
    assert "more segments needed" in str(statuses[1].missing)
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


@pytest.mark.parametrize(
    ("stage", "kept"),
    [
        ("selection.evaluate before", 1),
        ("process.save_database before", 1),
        ("process.save_database after", 2),
        ("checks.calibrate_with_checks before", 2),
        ("process.write_proposal after", 2),
    ],
)
def test_a_process_killed_at_any_stage_leaves_a_whole_database(
    tmp_path: Path, stage: str, kept: int
) -> None:
    path = tmp_path / "device.segments"
    device, segments = pieces(session(gyro_scale=1.02))
    first = DeviceCalibration(opening(path, device))
    first.answer(segments[0])
    first.answer(Finish())
    service = Service("tests.online_calibration.dying", *stage.split())
    service.ask(opening(path, device))
    with pytest.raises(ServiceEnded) as error:
        _ask_all(service, [*segments[1:], Finish()])
    assert error.value.status == -signal.SIGKILL
    # nobody holds it any more; segments of a recording that is read again replace those of before
    with locked_database(path):
        assert len(load_database(path)) == kept
    again = DeviceCalibration(opening(path, device))
    for request in (*segments, Finish()):
        status = again.answer(request)
    assert status.problem == ""
    assert status.kept == len(load_database(path)) == 3


def _ask_all(service: Service, requests: list[Piece | Finish]) -> None:
    for request in requests:
        service.ask(request)


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
