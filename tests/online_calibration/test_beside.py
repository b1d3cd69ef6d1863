"""A run that hands its segments on."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.algorithms.self_calibration.segments.database import load_database
from maplab_py.frontend.mapping import Mapping
from maplab_py.interop.recordings.map_replay import MapRecording
from maplab_py.online_calibration.beside import CalibrationBeside
from maplab_py.online_calibration.options import OnlineCalibrationOptions
from maplab_py.progress import SILENT
from maplab_py.sensors.sensors_yaml import write_sensors
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
