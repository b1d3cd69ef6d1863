"""The segment database: sessions, capacity, file, outdated segments."""

from __future__ import annotations

import dataclasses
import json
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from maplab_py.algorithms.self_calibration import pruning
from maplab_py.algorithms.self_calibration.options import SelfCalibrationOptions
from maplab_py.algorithms.self_calibration.pruning import SegmentTest
from maplab_py.algorithms.self_calibration.segments.database import (
    SegmentDatabase,
    load_database,
    save_database,
)
from maplab_py.algorithms.self_calibration.segments.selection import collect
from maplab_py.errors import EstimationError, UserError
from maplab_py.progress import SILENT
from maplab_py.sensors import CameraRig, Distortion, SensorSet
from maplab_py.vimap import VIMap
from tests.algorithms.self_calibration.scenes import (
    OPTIONS,
    assert_only_gaps,
    device,
    scene_map,
    uncalibrated,
)


@cache
def collected() -> SegmentDatabase:
    return collect(scene_map(vertices=61, noise=1.0), OPTIONS)[0]


def test_a_file_returns_the_database(tmp_path: Path) -> None:
    database, path = collected(), tmp_path / "device.segments"
    save_database(database, path)
    again = load_database(path)
    assert again.records == database.records
    assert (again.tables, again.metric, again.capacity) == (
        dict(database.tables),
        database.metric,
        database.capacity,
    )
    for name in ("vertices", "keypoints", "landmarks", "imu_edges", "imu_samples"):
        for column, values in getattr(database.vi_map, name).columns().items():
            np.testing.assert_array_equal(getattr(getattr(again.vi_map, name), column), values)
    save_database(again, tmp_path / "again.segments")
    assert (tmp_path / "again.segments").read_bytes() == path.read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["again.segments", "device.segments"]


def test_a_file_with_the_columns_of_before_is_read(tmp_path: Path) -> None:
    database, path, old = collected(), tmp_path / "new.segments", tmp_path / "old.segments"
    save_database(database, path)
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    del arrays["frames/descriptor_layout"]
    arrays["frames/descriptor_size"] = np.zeros(len(database.vi_map.frames), dtype=np.int32)
    with old.open("wb") as file:
        np.savez_compressed(file, **arrays)
    assert load_database(old).records == database.records
    save_database(load_database(old), tmp_path / "again.segments")
    assert (tmp_path / "again.segments").read_bytes() == path.read_bytes()


def test_a_save_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "device.segments"
    save_database(collected(), path)
    before = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="No space left"):
        save_database(collected(), path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_foreign_and_newer_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "device.segments"
    with pytest.raises(UserError, match="no such segment database"):
        load_database(path)
    save_database(collected(), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="damaged"):
        load_database(path)
    header = json.dumps({"format": "maplab-py segment database", "version": 99}).encode()
    with path.open("wb") as file:
        np.savez(file, header=np.frombuffer(header, dtype=np.uint8))
    with pytest.raises(UserError, match="version 99"):
        load_database(path)


def second_session() -> VIMap:
    """Another walk with the same device."""
    other = scene_map(vertices=61, noise=1.0, seed=2, device_seed=1)
    for one, same in zip(device(other), device(collected().vi_map), strict=True):
        assert one.id == same.id
    np.testing.assert_array_equal(device(other)[1].T_B_C, device(collected().vi_map)[1].T_B_C)
    return other


def test_sessions_compete_and_the_size_stays() -> None:
    database = collected()
    grown, report = collect(second_session(), OPTIONS, database)
    assert_only_gaps(grown.vi_map)
    assert len(grown) <= 3 * OPTIONS.segments_per_group
    assert report.dropped + len(database) - report.segments_kept + report.from_this_map == (
        2 * report.dropped
    )
    for table in grown.tables:
        best = sorted(one.scores[table] for one in grown.records)[: grown.capacity]
        assert [one.scores[table] for one in grown.ranked(table)] == best
    np.testing.assert_array_equal(grown.sigma_ref, database.sigma_ref)


def test_a_mission_that_comes_again_replaces_its_segments() -> None:
    database = collected()
    again, _ = collect(scene_map(vertices=61, noise=1.0), OPTIONS, database)
    assert {one.key for one in again.records} == {one.key for one in database.records}
    assert len(again.vi_map.vertices) == len(database.vi_map.vertices)


def test_other_states_need_another_database() -> None:
    with pytest.raises(UserError, match="--sc_states"):
        collect(second_session(), dataclasses.replace(OPTIONS, states="imu"), collected())


def test_pruning_keeps_the_best() -> None:
    database = collected()
    one = database.pruned(1)
    assert len(one) <= 3
    for table in one.tables:
        assert one.ranked(table)[0].key == database.ranked(table)[0].key


def seen_by(vi_map: VIMap, sensors: SensorSet) -> VIMap:
    """Return the map as a camera of other focal length and centre would have recorded it."""
    (f, c), (other_f, other_c) = (
        np.split(device(vi_map.replace(sensors=one))[1].cameras[0].intrinsics, 2)
        for one in (vi_map.sensors, sensors)
    )
    uv_px = (vi_map.keypoints.uv_px - c) / f * other_f + other_c
    return vi_map.replace(keypoints=vi_map.keypoints.replace(uv_px=uv_px))


def knocked(sensors: SensorSet) -> SensorSet:
    """Focal length and centre of a camera that was dropped."""
    rig = next(one for one in sensors.sensors.values() if isinstance(one, CameraRig))
    camera = rig.cameras[0]
    other = dataclasses.replace(
        camera, intrinsics=camera.intrinsics + np.array([12.0, 12.0, 20.0, -15.0])
    )
    changed = {**sensors.sensors, rig.id: CameraRig(rig.id, (other,), rig.T_B_C)}
    return dataclasses.replace(sensors, sensors=changed)


def renamed(sensors: SensorSet) -> SensorSet:
    """Return the same device under other ids, as another recording may have it."""
    other = {key: key[::-1] for key in sensors.sensors}
    return SensorSet(
        {
            other[key]: dataclasses.replace(one, id=other[key])
            for key, one in sensors.sensors.items()
        },
        {
            other[key]: dataclasses.replace(one, base_sensor_id=other[one.base_sensor_id])
            for key, one in sensors.extrinsics.items()
        },
    )


def results_of(
    database: SegmentDatabase, sensors: SensorSet, options: SelfCalibrationOptions
) -> list[SegmentTest]:
    return pruning.test_segments(database, sensors, options, pruning.PROBABILITY, SILENT)


def mutual_results_of(
    database: SegmentDatabase, options: SelfCalibrationOptions
) -> list[SegmentTest]:
    return pruning.test_mutual_consistency(database, options, pruning.PROBABILITY, SILENT)


def test_a_calibration_of_other_cameras_is_not_passed_over() -> None:
    other = scene_map(vertices=61, seed=3, distortion=Distortion.RADTAN).sensors
    with pytest.raises(UserError, match="of other cameras"):
        results_of(collected(), other, OPTIONS)


@pytest.mark.slow
def test_segments_of_a_device_that_changed_are_found() -> None:
    database = collected()
    sensors = database.vi_map.sensors
    assert not any(one.is_outdated for one in results_of(database, sensors, OPTIONS))
    assert all(one.is_outdated for one in results_of(database, knocked(sensors), OPTIONS))
    assert all(one.is_outdated for one in results_of(database, renamed(knocked(sensors)), OPTIONS))


@pytest.mark.slow
def test_a_calibration_that_was_wrong_from_the_start_makes_no_segment_outdated() -> None:
    database, _ = collect(uncalibrated(scene_map(vertices=61, noise=1.0)), OPTIONS)
    assert all(one.is_outdated for one in results_of(database, database.vi_map.sensors, OPTIONS))
    assert not any(one.is_outdated for one in mutual_results_of(database, OPTIONS))


@pytest.mark.slow
def test_segments_from_before_and_after_a_knock_are_told_apart() -> None:
    many = dataclasses.replace(OPTIONS, segments_per_group=20)
    first, _ = collect(scene_map(vertices=61, noise=1.0), many)
    held, now = first.vi_map.sensors, knocked(first.vi_map.sensors)
    database, _ = collect(seen_by(second_session(), now), many, first)
    is_first = [one.mission in {r.mission for r in first.records} for one in database.records]
    assert 0 < sum(is_first) < len(is_first)
    assert [one.is_outdated for one in results_of(database, held, many)] == [
        not one for one in is_first
    ]
    assert [one.is_outdated for one in results_of(database, now, many)] == is_first
    with pytest.raises(EstimationError, match=r"changed between sessions.*--calibration"):
        mutual_results_of(database, many)
