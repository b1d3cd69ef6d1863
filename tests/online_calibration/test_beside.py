"""A run that hands its segments on."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from maplab_plugins.rovioli import _calibration_beside

from maplab_py.algorithms.self_calibration.reports import SelfCalibrationReport
from maplab_py.algorithms.self_calibration.segments.database import load_database
from maplab_py.errors import UserError
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.mapping import Mapping
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.frontend.odometry_update import OdometryUpdate
from maplab_py.frontend.run_options import RunOptions
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.online_calibration.beside import CalibrationBeside, _Worker
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.online_calibration.process import Opening, Status
from maplab_py.progress import SILENT
from maplab_py.sensors.sensors_yaml import write_sensors
from maplab_py.vimap import to_hex
from maplab_py.vimap.tables import MissionSensor
from tests.frontend.known_start import KnownStart
from tests.frontend.simulated import replayed


def test_segments_of_a_run_reach_the_database(tmp_path: Path) -> None:
    vi_map, truth = replayed(cameras=1)
    options = OnlineCalibrationOptions(is_on=True, database=tmp_path / "device.segments")
    beside = CalibrationBeside(options)
    start = KnownStart(truth, with_biases=True)
    mapping = Mapping(MapRecording(vi_map, 0), observer=beside, make_starter=start)
    mapping.run()
    beside.finish(mapping, SILENT)
    # 81 vertices: two segments of 40 that share a vertex
    assert "2 segments evaluated, 2 in" in mapping.statistics.notes[-1]
    database = load_database(tmp_path / "device.segments")
    assert sorted(record.keyframes for record in database.records) == [40, 40]
    stamps = database.vi_map.vertices.timestamp_ns
    np.testing.assert_array_equal(stamps, vi_map.vertices.timestamp_ns[: len(stamps)])


def test_the_segment_before_a_divergence_does_not_count(tmp_path: Path) -> None:
    vi_map, truth = replayed(cameras=1)
    options = OnlineCalibrationOptions(is_on=True, database=tmp_path / "device.segments")
    beside = CalibrationBeside(options)

    class Diverging:
        def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
            is_last = mapping.statistics.frames == len(vi_map.vertices)
            beside.after_frame(dataclasses.replace(update, has_diverged=is_last), mapping)

    start = KnownStart(truth, with_biases=True)
    mapping = Mapping(MapRecording(vi_map, 0), observer=Diverging(), make_starter=start)
    mapping.run()
    beside.finish(mapping, SILENT)
    # the first of two segments was held back then; the second comes from the end of the map
    assert "1 segments evaluated, 1 in" in mapping.statistics.notes[-1]


def test_the_next_run_begins_with_a_proposal_only_if_it_shall(tmp_path: Path) -> None:
    vi_map, _ = replayed()
    recording = MapRecording(vi_map, 0)
    options = OnlineCalibrationOptions(is_on=True, database=tmp_path / "device.segments")
    device = recording.device
    camera = dataclasses.replace(device.cameras[0], intrinsics=device.cameras[0].intrinsics + 3.0)
    changed = device.with_cameras((camera, *device.cameras[1:]), device.T_I_C)
    options.proposal.write_text("# a calibration\n" + write_sensors(changed.sensors))
    assert CalibrationBeside(options).recalibrated(recording) is recording
    used = CalibrationBeside(dataclasses.replace(options, apply="next_start"))
    again = used.recalibrated(recording)
    np.testing.assert_allclose(again.device.cameras[0].intrinsics, camera.intrinsics)
    assert len(list(again.items())) == len(list(recording.items()))


def test_a_run_goes_on_with_another_calibration_as_a_new_mission() -> None:
    vi_map, truth = replayed(cameras=1)
    recording = MapRecording(vi_map, 0)
    camera = recording.device.cameras[0]
    camera = dataclasses.replace(camera, intrinsics=camera.intrinsics + 0.5)
    other = recording.device.with_cameras((camera,), recording.device.T_I_C).renamed()

    class Switch:
        def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
            if mapping.statistics.frames == 40:
                assert mapping.odometry.can_recalibrate
                mapping.recalibrate(other)

    mapping = Mapping(
        recording, observer=Switch(), make_starter=KnownStart(truth, with_biases=True)
    )
    mapping.run()
    assert mapping.builder is not None
    result, _ = mapping.builder.finish()
    count = np.bincount(result.vertices.mission)
    assert len(count) == 2
    assert count.sum() == len(vi_map.vertices)
    rigs = result.missions.sensor_id[:, int(MissionSensor.NCAMERA)]
    used = [result.sensors.camera_rig(to_hex(rig)).cameras[0].intrinsics for rig in rigs]
    np.testing.assert_allclose(used[1], used[0] + 0.5)
    start = mapping.statistics.starts[1]
    assert start.reason == "another calibration"
    assert start.waited_s < 0.2
    # the second mission begins where the first one ends
    p_G = result.T_G_I[:, 4:]
    error = p_G - truth.T_R_B[:, 4:]
    assert np.linalg.norm(np.diff(error, axis=0), axis=1).max() < 0.02


@pytest.mark.parametrize("is_damaged", [False, True])
def test_a_proposal_is_used_at_once_or_refused_in_one_note(
    tmp_path: Path, *, is_damaged: bool
) -> None:
    vi_map, truth = replayed(cameras=1)
    recording = MapRecording(vi_map, 0)
    device = recording.device
    camera = dataclasses.replace(device.cameras[0], intrinsics=device.cameras[0].intrinsics + 0.5)
    changed = device.with_cameras((camera,), device.T_I_C)
    database = tmp_path / "device.segments"
    options = OnlineCalibrationOptions(is_on=True, database=database, apply="now")
    text = "# cut" if is_damaged else "# a calibration\n" + write_sensors(changed.sensors)
    options.proposal.write_text(text)
    beside = CalibrationBeside(options)
    openings: list[Opening] = []
    worker = SimpleNamespace(
        is_opening=False, newest=Status(), put=lambda _: None, open_again=openings.append
    )

    class Proposing:
        def after_frame(self, update: OdometryUpdate, mapping: Mapping) -> None:
            beside.after_frame(update, mapping)
            if mapping.statistics.frames == 40:  # the process answers
                proposal = SimpleNamespace(parameters=())
                worker.newest = Status(proposal=cast(SelfCalibrationReport, proposal))
                beside._worker, beside._device = cast(_Worker, worker), device
            worker.is_opening = bool(openings)

    start = KnownStart(truth, with_biases=True)
    mapping = Mapping(recording, observer=Proposing(), make_starter=start)
    mapping.run()
    assert mapping.builder is not None
    assert len(mapping.builder.missions) == (1 if is_damaged else 2)
    notes = [note for note in mapping.statistics.notes if "another calibration" in note]
    refusals = [note for note in mapping.statistics.notes if "is not used" in note]
    assert (len(notes), len(refusals)) == ((0, 1) if is_damaged else (1, 0))
    for opening in openings:
        np.testing.assert_allclose(opening.device.cameras[0].intrinsics, camera.intrinsics)


def test_sensors_with_another_image_delay_have_other_ids() -> None:
    device = MapRecording(replayed()[0], 0).device.renamed()
    late = tuple(dataclasses.replace(camera, image_delay_s=1e-3) for camera in device.cameras)
    assert device.with_cameras(late, device.T_I_C).renamed().rig_id != device.rig_id
    assert device.renamed().rig_id == device.rig_id


@pytest.mark.parametrize(("estimate", "folder"), [("intrinsics", None), ("none", Path("map"))])
def test_switching_is_refused_where_the_window_has_more_states(
    estimate: str, folder: Path | None
) -> None:
    options = OnlineCalibrationOptions(is_on=True, database=Path("device.segments"), apply="now")
    run = RunOptions(
        odometry=OdometryOptions(estimate=estimate),
        localization=OnlineLocalizationOptions(map_folder=folder),
    )
    with pytest.raises(UserError, match="--sc_apply=now cannot be combined"):
        _calibration_beside(run, options)
