"""Recordings whose IMU and cameras have different clocks: shifted ones, and ones that start again alone."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.interop.recordings.opening import open_recording
from maplab_py.interop.recordings.options import ReadingOptions, SourceOptions
from maplab_py.interop.recordings.stream import EventStream
from tests.interop.recordings.test_clocks import bag_messages, opened, written_bag
from tests.interop.recordings.written import (
    START_NS,
    Content,
    frame_sets,
    make_content,
    samples,
    write_bag,
    write_calibration,
    write_folder,
)

SECOND = 1_000_000_000
BOOT_NS = START_NS - 77 * SECOND


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    folder = write_folder(make_content(frames=1), tmp_path / "calibrated")
    return write_calibration(import_calibration(folder), tmp_path / "sensors.yaml")


def as_folder(content: Content, path: Path) -> Path:
    return write_folder(content, path / "room")


def as_bag(content: Content, path: Path) -> Path:
    return write_bag(content, path / "room.bag", delay_ns=(BOOT_NS, 0))


@pytest.mark.parametrize("write", [as_folder, as_bag])
def test_imu_since_boot_with_images_by_calendar(
    write: Callable[[Content, Path], Path], tmp_path: Path, calibration: Path
) -> None:
    content = make_content(frames=14)
    path = write(dataclasses.replace(content, imu_ns=content.imu_ns - BOOT_NS), tmp_path)
    with pytest.raises(
        MapError, match=r"no time in common.* 76980000000 to .*, the images"
    ) as info:
        open_recording(path, SourceOptions(calibration))
    assert str(content.stamps_ns[0][0]) in str(info.value)
    (offset,) = re.findall(r"--imu_to_camera_time_offset_ns \((-\d+) ", str(info.value))
    # exact by arrival; in folders, samples begin 20 ms before the images
    assert int(offset) == -BOOT_NS - (20_000_000 if path.is_dir() else 0)
    given = SourceOptions(calibration, imu_to_camera_time_offset_ns=-BOOT_NS)
    events = list(EventStream(open_recording(path, given)))
    assert len(samples(events)[0]) == len(content.imu_ns)
    assert [s.images[0].stamp_ns for s in frame_sets(events)] == content.stamps_ns[0].tolist()
    assert frame_sets(events)[0].time_ns == content.stamps_ns[0][0] - BOOT_NS


def restarted(*, imu: bool) -> tuple[Content, Content]:
    """Two runs of 0.7 s, 3 s apart; in the second, the clock of IMU or cameras starts again alone."""
    first = make_content(frames=14)
    back, on = first.imu_ns + 1000, first.imu_ns + 3 * SECOND
    second = dataclasses.replace(
        first,
        imu_ns=back if imu else on,
        stamps_ns=tuple(stamps + (3 * SECOND if imu else 1000) for stamps in first.stamps_ns),
    )
    return first, second


def joined(first: Content, second: Content) -> Content:
    return Content(
        np.concatenate([first.imu_ns, second.imu_ns]),
        np.concatenate([first.accel_gyro, second.accel_gyro]),
        tuple(np.concatenate(pair) for pair in zip(first.stamps_ns, second.stamps_ns, strict=True)),
        tuple([*a, *b] for a, b in zip(first.images, second.images, strict=True)),
    )


@pytest.mark.parametrize("kind", ["folder", "bag"])
@pytest.mark.parametrize("imu", [True, False], ids=["imu", "cameras"])
def test_only_one_clock_starts_again(
    imu: bool, kind: str, tmp_path: Path, calibration: Path
) -> None:
    first, second = restarted(imu=imu)
    shift_ns = (1 if imu else -1) * (1000 - 3 * SECOND)  # of the IMU beside the cameras
    if kind == "folder":
        path = as_folder(joined(first, second), tmp_path)
    else:
        path = written_bag(tmp_path, bag_messages(first, second, step_ns=3 * SECOND))

    def part(number: int, offset_ns: int | None = None) -> SourceOptions:
        reading = ReadingOptions(recording_part=number)
        return SourceOptions(calibration, reading=reading, imu_to_camera_time_offset_ns=offset_ns)

    events = list(EventStream(open_recording(path, part(1))))
    assert [s.time_ns for s in frame_sets(events)] == first.stamps_ns[0].tolist()
    if kind == "bag" or imu:  # else the images end the part
        assert set(samples(events)[0]) >= set(first.imu_ns)
    with pytest.raises(MapError, match="only one of the clocks of IMU and images starts") as info:
        open_recording(path, part(2))
    (offset,) = re.findall(r"--imu_to_camera_time_offset_ns \((-?\d+) ", str(info.value))
    if kind == "bag" or imu:  # else it is not known how long the cameras stood still
        assert abs(int(offset) - shift_ns) < SECOND // 10
    events = list(EventStream(open_recording(path, part(2, shift_ns))))
    assert set(samples(events)[0]) >= set(second.imu_ns)
    assert [s.images[0].stamp_ns for s in frame_sets(events)] == second.stamps_ns[0].tolist()
    times_ns = second.stamps_ns[0] + shift_ns
    assert [s.time_ns for s in frame_sets(events)] == times_ns.tolist()


def test_only_one_of_two_cameras_starts_again(tmp_path: Path, calibration: Path) -> None:
    first = make_content(frames=14)
    stamps = (first.stamps_ns[0], np.concatenate([first.stamps_ns[1][:7]] * 2))
    late = dataclasses.replace(first, stamps_ns=(stamps[0] + SECOND, first.stamps_ns[1]))
    path = written_bag(tmp_path, bag_messages(first, late))
    with pytest.raises(MapError, match=r"camera 0 1, camera 1 2\).*--rovio_active_camera_indices"):
        opened(path, calibration, recording_part=1)
