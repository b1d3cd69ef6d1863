"""Stamps that repeat, come late or start again, and clocks of IMU and cameras that differ."""

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.interop.recordings import clocks, summary
from maplab_py.interop.recordings.options import ReadingOptions, SourceOptions, StreamOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.recordings.stream import EventStream
from tests.interop.recordings.written import (
    START_NS,
    Content,
    assert_content,
    frame_sets,
    image_message,
    imu_message,
    make_content,
    samples,
    write_bag,
    write_calibration,
    write_folder,
    write_messages,
)

SECOND = 1_000_000_000
P_STEPS = (0.3, 0.3, 0.3, 0.05, 0.03, 0.01, 0.01)


def shifted(content: Content, shift_ns: int) -> Content:
    stamps = tuple(stamps + shift_ns for stamps in content.stamps_ns)
    return dataclasses.replace(content, imu_ns=content.imu_ns + shift_ns, stamps_ns=stamps)


def bag_messages(*contents: Content, step_ns: int = 10 * SECOND) -> list[tuple[int, str, Any]]:
    """Messages (arrival, topic, message) of recordings one after the other, each clock on its own."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    messages: list[tuple[int, str, Any]] = []
    for number, content in enumerate(contents):
        start_ns = START_NS + number * step_ns
        delay_ns = start_ns - int(content.imu_ns[0])
        for t, v in zip(content.imu_ns.tolist(), content.accel_gyro, strict=True):
            messages.append((t + delay_ns, "/imu0", imu_message(store, t, v, 1)))
        for camera, (stamps, images) in enumerate(
            zip(content.stamps_ns, content.images, strict=True)
        ):
            delay_ns = start_ns + 20_000_000 - int(content.stamps_ns[0][0])
            for t, image in zip(stamps.tolist(), images, strict=True):
                message = image_message(store, t, image, "mono8", 1)
                messages.append((t + delay_ns, f"/cam{camera}/image_raw", message))
    return sorted(messages, key=lambda entry: entry[:2])


def written_bag(tmp_path: Path, messages: list[tuple[int, str, Any]]) -> Path:
    from rosbags.typesys import Stores, get_typestore

    path = tmp_path / "a.bag"
    path.unlink(missing_ok=True)
    write_messages(path, get_typestore(Stores.ROS1_NOETIC), messages)
    return path


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    pytest.importorskip("rosbags")
    device = open_recording(write_folder(make_content(frames=2), tmp_path / "device")).device
    return write_calibration(device, tmp_path / "sensors.yaml")


def opened(path: Path, calibration: Path, imu_topic: str = "", **reading: Any):
    options = SourceOptions(
        sensor_calibration_file=calibration,
        imu_topic=imu_topic,
        reading=ReadingOptions(**reading),
    )
    return open_recording(path, options)


@pytest.mark.parametrize(
    ("stamps", "parts", "dropped"),
    [
        ([1, 2, 3, 4], [[0, 1, 2, 3]], []),
        ([1, 2, 2, 3], [[0, 1, 3]], [2]),
        ([1, 3, 2, 4], [[0, 1, 3]], [2]),
        ([1, 2, 3, 2, 3, 4], [[0, 1, 2, 5]], [3, 4]),  # a buffer that is delivered twice
        ([0, 10**12, 10**12 + 1, 10**12 + 2], [[1, 2, 3]], [0]),
        ([1, 2, 10**12, 3, 4], [[0, 1, 3, 4]], [2]),
        ([1, 2, 3, 10**12], [[0, 1, 2]], [3]),
    ],
)
def test_rows_that_are_left_out(
    stamps: list[int], parts: list[list[int]], dropped: list[int]
) -> None:
    kept, left_out = clocks.parts_of(np.array(stamps) * 10**7)
    assert [part.tolist() for part in kept] == parts
    assert left_out.tolist() == dropped


def test_stamps_that_simply_follow_pass_as_if_pushed() -> None:
    rng = np.random.default_rng(8)
    steps = rng.choice([100, 100, 100, 0, -150, -100_000, 2 * 86_400_000], size=2000, p=P_STEPS)
    pushed: clocks.ClockFilter[int] = clocks.ClockFilter()
    mixed: clocks.ClockFilter[int] = clocks.ClockFilter()
    restarts = 0
    for row, stamp_ns in enumerate((np.cumsum(steps) * 1_000_000 + START_NS).tolist()):
        expected = pushed.push(stamp_ns, row)
        simple = mixed.passes(stamp_ns)
        assert expected == ([(stamp_ns, row)] if simple else mixed.push(stamp_ns, row))
        assert (mixed.part, mixed.dropped, mixed.first) == (
            pushed.part,
            pushed.dropped,
            pushed.first,
        )
        restarts = mixed.part
    assert restarts > 1
    assert mixed.dropped > 10


def four_runs(tmp_path: Path) -> tuple[Path, list[Content]]:
    runs = [shifted(make_content(frames=14), -START_NS + k * SECOND // 10) for k in range(3)]
    runs = [shifted(run, SECOND) for run in runs]
    merged = Content(
        np.concatenate([run.imu_ns for run in runs]),
        np.concatenate([run.accel_gyro for run in runs]),
        tuple(np.concatenate([run.stamps_ns[c] for run in runs]) for c in (0, 1)),
        tuple([image for run in runs for image in run.images[c]] for c in (0, 1)),
    )
    folder = write_folder(merged, tmp_path / "room")
    for camera in (0, 1):  # files of equal stamps: names of their own
        home = folder / f"mav0/cam{camera}"
        lines = ["#timestamp [ns],filename"]
        import cv2

        for number, (stamp, image) in enumerate(
            zip(merged.stamps_ns[camera].tolist(), merged.images[camera], strict=True)
        ):
            cv2.imwrite(str(home / "data" / f"image {number}.png"), image)
            lines.append(f"{stamp},image {number}.png")
        (home / "data.csv").write_text("\n".join(lines) + "\n")
    return folder, runs


def test_parts_of_a_folder(tmp_path: Path) -> None:
    folder, runs = four_runs(tmp_path)
    for part, run in enumerate(runs, start=1):
        options = SourceOptions(reading=ReadingOptions(recording_part=part))
        assert_content(list(EventStream(open_recording(folder, options))), run)
    report = summary.summarise(open_recording(folder))
    assert [part.part for part in report.parts] == [1, 2, 3]
    assert {part.images for part in report.parts} == {28}
    assert report.imu is not None
    assert report.imu.samples == len(runs[0].imu_ns)
    assert "figures are of part 1 of 3" in report.notes[0]
    with pytest.raises(
        clocks.ClockRestart, match=r"data.csv:\d+: the clock starts again: \d+ comes after"
    ):
        list(EventStream(open_recording(folder)))
    stream = EventStream(open_recording(folder), StreamOptions(end_s=0.5))
    assert frame_sets(list(stream))
    with pytest.raises(UserError, match="--recording_part=4: the recording has 3 parts"):
        list(
            EventStream(
                open_recording(folder, SourceOptions(reading=ReadingOptions(recording_part=4)))
            )
        )


def test_parts_of_a_bag(tmp_path: Path, calibration: Path) -> None:
    runs = [shifted(make_content(frames=14), -START_NS + SECOND + k) for k in range(3)]
    path = written_bag(tmp_path, bag_messages(*runs))
    for part, run in enumerate(runs, start=1):
        recording = opened(path, calibration, recording_part=part)
        assert recording.start_ns == int(run.imu_ns[0])
        assert_content(list(EventStream(recording)), run)
    report = summary.summarise(opened(path, calibration))
    assert [(part.part, part.images) for part in report.parts] == [(1, 28), (2, 28), (3, 28)]
    with pytest.raises(clocks.ClockRestart, match="--recording_part=N"):
        list(EventStream(opened(path, calibration)))
    ended = EventStream(opened(path, calibration), StreamOptions(end_s=0.3))
    assert frame_sets(list(ended))
    with pytest.raises(UserError, match="--recording_part=9: the recording has 3 parts"):
        opened(path, calibration, recording_part=9)


def test_repeated_and_late_messages_of_a_bag(tmp_path: Path, calibration: Path) -> None:
    content = make_content(frames=20)
    messages = bag_messages(content)
    imu = [row for row, entry in enumerate(messages) if entry[1] == "/imu0"]
    images = [row for row, entry in enumerate(messages) if entry[1] == "/cam0/image_raw"]
    repeated = [*messages[: imu[50] + 1], messages[imu[50]], *messages[imu[50] + 1 :]]
    recording = opened(written_bag(tmp_path, repeated), calibration)
    assert_content(list(EventStream(recording)), content)
    (note,) = recording.notes
    assert "/imu0: left out 1 with repeated, late or wild stamps" in note
    stamp = messages[images[5]][2].header
    stamp.stamp = messages[images[4]][2].header.stamp  # one image with the stamp of the one before
    path = written_bag(tmp_path, messages)
    assert len(frame_sets(list(EventStream(opened(path, calibration))))) == 19
    with pytest.raises(MapError, match=r"1 of 20 stamps .*--max_late_share=0"):
        list(EventStream(opened(path, calibration, max_late_share=0.0)))
    late = StreamOptions(start_s=0.4)
    strict = opened(path, calibration, max_late_share=0.0)
    assert len(frame_sets(list(EventStream(strict, late)))) == 12


def test_rows_of_another_clock_are_named(tmp_path: Path) -> None:
    content = make_content(frames=4)
    folder = write_folder(content, tmp_path / "room")
    table = folder / "mav0/imu0/data.csv"
    lines = table.read_text().splitlines()
    lines[20] = "77," + lines[20].split(",", 1)[1]
    table.write_text("\n".join(lines) + "\n")
    recording = open_recording(folder)
    times_ns, _ = samples(list(EventStream(recording)))
    np.testing.assert_array_equal(times_ns, np.delete(content.imu_ns, 19))
    (note,) = recording.notes
    assert note.endswith(f"the first is 77 beside {content.imu_ns[18]} (lines 21)")
    for row in (21, 22, 30):
        lines[row] = f"{row}," + lines[row].split(",", 1)[1]
    table.write_text("\n".join(lines) + "\n")
    with pytest.raises(MapError, match=r"imu0/data.csv:21: 4 of \d+ stamps do not come after"):
        list(EventStream(open_recording(folder)))
    some = SourceOptions(reading=ReadingOptions(max_late_share=0.1))
    assert (
        len(samples(list(EventStream(open_recording(folder, some))))[0]) == len(content.imu_ns) - 4
    )


def test_zero_stamps_and_arrival_times(tmp_path: Path, calibration: Path) -> None:
    content = make_content(frames=8)
    messages = bag_messages(content)
    images = [entry for entry in messages if entry[1] == "/cam0/image_raw"]
    images[0][2].header.stamp.sec = images[0][2].header.stamp.nanosec = 0
    recording = opened(written_bag(tmp_path, messages), calibration)
    assert recording.start_ns == int(content.imu_ns[0])
    assert len(frame_sets(list(EventStream(recording)))) == 7
    assert recording.notes[0].endswith(f"the first is 0 beside {content.stamps_ns[0][1]}")
    for entry in images:
        entry[2].header.stamp.sec = entry[2].header.stamp.nanosec = 0
    path = written_bag(tmp_path, messages)
    with pytest.raises(
        MapError, match=r"/cam0/image_raw: the stamps .* are all 0.*--use_arrival_time"
    ):
        opened(path, calibration)
    arrived = opened(path, calibration, use_arrival_time=True)
    assert len(frame_sets(list(EventStream(arrived)))) == 8
    with pytest.raises(UserError, match="--use_arrival_time applies to bags only"):
        open_recording(
            tmp_path / "device", SourceOptions(reading=ReadingOptions(use_arrival_time=True))
        )


def test_samples_that_are_no_numbers(tmp_path: Path, calibration: Path) -> None:
    content = make_content(frames=20)
    content.accel_gyro[[50, 51], 2] = np.nan
    path = written_bag(tmp_path, bag_messages(content))
    recording = opened(path, calibration)
    times_ns, _ = samples(list(EventStream(recording)))
    np.testing.assert_array_equal(times_ns, np.delete(content.imu_ns, [50, 51]))
    (note,) = recording.notes
    assert note.endswith(f"left out 2 that are no numbers, the first at {content.imu_ns[50]}")
    with pytest.raises(
        MapError, match=r"2 of 199 samples are left out, .* is no number: skip them"
    ):
        list(EventStream(opened(path, calibration, max_late_share=0.0)))
    content.accel_gyro[100:140] = np.inf
    path = written_bag(tmp_path, bag_messages(content))
    times_ns, _ = samples(list(EventStream(opened(path, calibration, max_late_share=0.5))))
    assert len(times_ns) == len(content.imu_ns) - 42


def test_gyroscope_and_accelerometer_on_two_topics(tmp_path: Path, calibration: Path) -> None:
    content = make_content(frames=8)
    ramp = np.linspace(0.0, 1.0, len(content.imu_ns))
    content.accel_gyro[:, :3] = ramp[:, None] * [1.0, 2.0, 9.0]
    messages = bag_messages(content)
    gyro = [entry for entry in messages if entry[1] == "/imu0"]
    both: list[tuple[int, str, Any]] = [entry for entry in messages if entry[1] != "/imu0"]
    for number, (arrival, _, message) in enumerate(gyro):
        zero = type(message.linear_acceleration)(0.0, 0.0, 0.0)
        both.append((arrival, "/gyro", dataclasses.replace(message, linear_acceleration=zero)))
        if number % 3 == 0:
            both.append((arrival, "/accel", dataclasses.replace(message, angular_velocity=zero)))
    path = written_bag(tmp_path, sorted(both, key=lambda entry: entry[:2]))
    times_ns, values = samples(list(EventStream(opened(path, calibration, "/gyro,/accel"))))
    np.testing.assert_array_equal(times_ns, content.imu_ns[: len(times_ns)])
    assert len(times_ns) >= len(content.imu_ns) - 3
    np.testing.assert_allclose(values, content.accel_gyro[: len(times_ns)], atol=1e-12)
    report = summary.summarise(opened(path, calibration, "/gyro"))
    assert any(
        "all accelerations of the IMU are 0: --imu_topic=GYRO,ACCEL" in n for n in report.notes
    )


def test_tables_of_zeros_and_a_zero_at_first(tmp_path: Path) -> None:
    content = make_content(frames=6)
    folder = write_folder(content, tmp_path / "room")
    table = folder / "mav0/cam0/data.csv"
    header, *rows = table.read_text().splitlines()
    zeros = [f"0,{row.split(',')[1]}" for row in rows]
    table.write_text("\n".join([header, zeros[0], *rows[1:]]) + "\n")
    recording = open_recording(folder)
    assert len(frame_sets(list(EventStream(recording)))) == 5
    assert f"the first is 0 beside {content.stamps_ns[0][1]} (lines 2)" in recording.notes[0]
    table.write_text("\n".join([header, *zeros]) + "\n")
    with pytest.raises(MapError, match=r"cam0/data.csv: all time stamps are 0"):
        open_recording(folder)


def test_what_is_odd_is_noted(tmp_path: Path) -> None:
    content = make_content(frames=30)
    slow = dataclasses.replace(
        content, imu_ns=content.imu_ns[:180:8], accel_gyro=content.accel_gyro[:180:8]
    )
    stamps = tuple(times.copy() for times in content.stamps_ns)
    stamps[0][20:] += 60 * SECOND
    stamps[1][:] += 7_000_000
    folder = write_folder(dataclasses.replace(slow, stamps_ns=stamps), tmp_path / "room")
    (folder / "mav0/cam3").mkdir()
    notes = " | ".join(summary.summarise(open_recording(folder)).notes)
    for words in (
        "cam3: not read",
        "the IMU delivers 25 samples per second",
        "the IMU ends at 0.88 s, the images at 61.47 s",
        "camera 0: no images for 60.05 s from 0.97 s on",
        "30 of 30 images of camera 1 have no partner in camera 0",
    ):
        assert words in notes


BOOT_NS = START_NS - 77 * SECOND


@pytest.fixture
def imported_calibration(tmp_path: Path) -> Path:
    folder = write_folder(make_content(frames=1), tmp_path / "calibrated")
    return write_calibration(import_calibration(folder), tmp_path / "sensors.yaml")


def as_folder(content: Content, path: Path) -> Path:
    return write_folder(content, path / "room")


def as_bag(content: Content, path: Path) -> Path:
    return write_bag(content, path / "room.bag", delay_ns=(BOOT_NS, 0))


@pytest.mark.parametrize("write", [as_folder, as_bag])
def test_imu_since_boot_with_images_by_calendar(
    write: Callable[[Content, Path], Path], tmp_path: Path, imported_calibration: Path
) -> None:
    content = make_content(frames=14)
    path = write(dataclasses.replace(content, imu_ns=content.imu_ns - BOOT_NS), tmp_path)
    with pytest.raises(
        MapError, match=r"no time in common.* 76980000000 to .*, the images"
    ) as info:
        open_recording(path, SourceOptions(imported_calibration))
    assert str(content.stamps_ns[0][0]) in str(info.value)
    (offset,) = re.findall(r"--imu_to_camera_time_offset_ns \((-\d+) ", str(info.value))
    # exact by arrival; in folders, samples begin 20 ms before the images
    assert int(offset) == -BOOT_NS - (20_000_000 if path.is_dir() else 0)
    given = SourceOptions(imported_calibration, imu_to_camera_time_offset_ns=-BOOT_NS)
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
    imu: bool, kind: str, tmp_path: Path, imported_calibration: Path
) -> None:
    first, second = restarted(imu=imu)
    shift_ns = (1 if imu else -1) * (1000 - 3 * SECOND)  # of the IMU beside the cameras
    if kind == "folder":
        path = as_folder(joined(first, second), tmp_path)
    else:
        path = written_bag(tmp_path, bag_messages(first, second, step_ns=3 * SECOND))

    def part(number: int, offset_ns: int | None = None) -> SourceOptions:
        reading = ReadingOptions(recording_part=number)
        return SourceOptions(
            imported_calibration, reading=reading, imu_to_camera_time_offset_ns=offset_ns
        )

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


def test_only_one_of_two_cameras_starts_again(tmp_path: Path, imported_calibration: Path) -> None:
    first = make_content(frames=14)
    stamps = (first.stamps_ns[0], np.concatenate([first.stamps_ns[1][:7]] * 2))
    late = dataclasses.replace(first, stamps_ns=(stamps[0] + SECOND, first.stamps_ns[1]))
    path = written_bag(tmp_path, bag_messages(first, late))
    with pytest.raises(MapError, match=r"camera 0 1, camera 1 2\).*--rovio_active_camera_indices"):
        opened(path, imported_calibration, recording_part=1)
