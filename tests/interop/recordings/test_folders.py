"""EuRoC and TUM-VI folders: written and read again, real ones, and damaged ones."""

import dataclasses
import re
import shutil
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from maplab_py.errors import FlagError, MapError, MaplabError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.recordings import protocol, summary
from maplab_py.interop.recordings.options import ReadingOptions, SourceOptions, StreamOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.sensors.sensors_yaml import write_sensors
from tests.interop.recordings.written import (
    START_NS,
    assert_content,
    assert_in_order,
    frame_sets,
    make_content,
    samples,
    write_calibration,
    write_folder,
)
from tests.support.data import shared_data
from tests.support.own_process import in_own_process


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder(make_content(), tmp_path / "room")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_folder_reads_back(tmp_path: Path, dtype: type, channels: int) -> None:
    content = make_content(dtype=dtype, channels=channels)
    recording = open_recording(write_folder(content, tmp_path / "room"))
    events = list(EventStream(recording))
    assert_content(events, content)
    assert list(map(type, EventStream(recording))) == list(map(type, events))  # read again


def test_the_path_may_be_mav0(folder: Path) -> None:
    assert_content(list(EventStream(open_recording(folder / "mav0"))), make_content())


def test_names_of_images_with_their_folder_and_in_quotes(tmp_path: Path) -> None:
    content = make_content(frames=3)
    folder = write_folder(content, tmp_path / "room")
    for camera, row in (("cam0", '"{}","data/{}"'), ("cam1", "{},./data/{}")):
        table = folder / "mav0" / camera / "data.csv"
        lines = [row.format(*line.split(",")) for line in table.read_text().splitlines()[1:]]
        table.write_text("\n".join(['"#timestamp [ns]","filename"', *lines]) + "\n")
    assert_content(list(EventStream(open_recording(folder))), content)
    table.write_text(table.read_text().replace("./data/", "../"))
    with pytest.raises(MapError, match=r"data.csv:2: .* image in data/, not '\d+,../\d+.png'"):
        open_recording(folder)


def test_an_imu_in_us_beside_images_in_ns(tmp_path: Path) -> None:
    content = make_content(frames=6)
    folder = write_folder(content, tmp_path / "room")
    table = folder / "mav0/imu0/data.csv"
    header, *rows = table.read_text().splitlines()
    shortened = [f"{row[:16]}{row[19:]}" for row in rows]
    table.write_text("\n".join([header, *shortened]) + "\n")
    report = summary.summarise(open_recording(folder))
    assert report.imu is not None
    assert (report.frame_sets, report.imu.samples) == (6, len(rows))
    assert report.imu.rate_hz == pytest.approx(200.0)
    assert any(f"{table}: time stamps are read as us: in ns" in note for note in report.notes)


def test_missing_images_of_all_cameras_are_listed_and_left_out(tmp_path: Path) -> None:
    content = make_content(frames=8)
    folder = write_folder(content, tmp_path / "room")
    missing = [
        folder / f"mav0/cam{camera}/data/{content.stamps_ns[camera][row]}.png"
        for camera, row in ((0, 2), (0, 3), (1, 6))
    ]
    for path in missing:
        path.unlink()
    message = r"the image is missing \(2 of 8 in cam0, 1 of 8 in cam1\).*--skip_missing_images"
    with pytest.raises(MapError, match=message):
        list(EventStream(open_recording(folder)))
    skipping = SourceOptions(reading=ReadingOptions(skip_missing_images=True))
    report = summary.summarise(open_recording(folder, skipping))
    assert report.frame_sets == 5
    assert [note for note in report.notes if "missing, left out" in note] == [
        f"missing, left out: {path}" for path in missing
    ]


def test_some_cameras(folder: Path) -> None:
    content, options = make_content(), SourceOptions(rovio_active_camera_indices="1")
    recording = open_recording(folder, options)
    assert recording.device.rig_id != open_recording(folder).device.rig_id
    second = dataclasses.replace(
        content, stamps_ns=content.stamps_ns[1:], images=content.images[1:]
    )
    assert_content(list(EventStream(recording)), second)
    np.testing.assert_allclose(recording.device.T_I_C[:, 4:], [[0.1, 0.0, 0.02]])
    for wrong in ("2", "0,0", "-1", "x"):
        with pytest.raises(MaplabError, match="rovio_active_camera_indices"):
            open_recording(folder, SourceOptions(rovio_active_camera_indices=wrong))


@pytest.mark.parametrize("delays_s", [(0.02, 0.02), (-0.008, -0.01), (0.0, 0.0)])
def test_images_count_at_the_time_of_their_middle_row(
    folder: Path, tmp_path: Path, delays_s: tuple[float, float]
) -> None:
    device = open_recording(folder).device
    line_ns = 20_000 if delays_s[1] < 0.0 else 0
    late = [
        dataclasses.replace(c, image_delay_s=s, time_offset_ns=3_000_000, line_delay_ns=line_ns)
        for c, s in zip(device.cameras, delays_s, strict=True)
    ]
    given = device.with_sensor(dataclasses.replace(device.rig, cameras=tuple(late)))
    file = tmp_path / "sensors.yaml"
    file.write_text(write_sensors(given.sensors))
    opened = open_recording(folder, SourceOptions(file)).device
    pixels = np.array([[0.0, 0.0], [3.0, 0.5 * late[0].height_px]])
    middle_s = [camera.delay_s(pixels)[1] for camera in opened.cameras]
    assert np.mean(middle_s) == pytest.approx(0.0, abs=1e-9)
    for ours, theirs in zip(opened.cameras, late, strict=True):
        assert ours.line_delay_ns == theirs.line_delay_ns
        seen_s, truth_s = (1e-9 * c.time_offset_ns + c.delay_s(pixels) for c in (ours, theirs))
        np.testing.assert_allclose(seen_s, truth_s, atol=1e-12)
    assert len({camera.time_offset_ns for camera in opened.cameras}) == 1
    is_noted = any("time of their middle row" in note for note in opened.notes)
    assert is_noted == (opened.cameras[0].time_offset_ns != 3_000_000)


def test_a_time_offset_replaces_that_of_the_calibration(folder: Path) -> None:
    plain = open_recording(folder)
    late = open_recording(folder, SourceOptions(imu_to_camera_time_offset_ns=4_000_000))
    assert {camera.time_offset_ns for camera in late.device.cameras} == {4_000_000}
    images, late_images = (
        [item for item in recording.items() if isinstance(item, protocol.CameraImage)]
        for recording in (plain, late)
    )
    assert [image.stamp_ns for image in late_images] == [image.stamp_ns for image in images]
    shifts = {a.time_ns - b.time_ns for a, b in zip(late_images, images, strict=True)}
    assert shifts == {4_000_000}


def test_part_of_a_recording(folder: Path) -> None:
    content, recording = make_content(), open_recording(folder)
    events = list(EventStream(recording, StreamOptions(start_s=0.1, end_s=0.2)))
    begin, end = START_NS - 20_000_000 + 100_000_000, START_NS - 20_000_000 + 200_000_000
    times_ns, _ = samples(events)
    inside = (content.imu_ns >= begin) & (content.imu_ns < end)
    np.testing.assert_array_equal(times_ns, content.imu_ns[inside])
    wanted = content.stamps_ns[0]
    assert [s.time_ns for s in frame_sets(events)] == wanted[
        (wanted >= begin) & (wanted < end)
    ].tolist()
    with pytest.raises(UserError, match="nothing was recorded from 100 s on"):
        list(EventStream(recording, StreamOptions(start_s=100.0)))
    for times in ({"start_s": -1.0}, {"start_s": 2.0, "end_s": 1.0}):
        with pytest.raises(FlagError, match="--vio_rosbag"):
            StreamOptions(**times)


def test_frames_before_the_first_imu_sample_are_dropped_and_counted(tmp_path: Path) -> None:
    content = make_content()
    late = dataclasses.replace(
        content, imu_ns=content.imu_ns[20:], accel_gyro=content.accel_gyro[20:]
    )
    stream = EventStream(open_recording(write_folder(late, tmp_path / "room")))
    events = list(stream)
    assert stream.statistics.dropped_before_imu == 2
    assert isinstance(events[0], protocol.ImuBatch)
    assert len(frame_sets(events)) == 6


def test_gaps_and_saturation_are_reported(tmp_path: Path) -> None:
    content = make_content()
    keep = np.ones(len(content.imu_ns), dtype=np.bool_)
    keep[30:50] = False
    values = content.accel_gyro.copy()
    values[5, 4] = -7.5  # the limit of maplab's default gyroscope
    values[6, 0] = 200.0
    gappy = dataclasses.replace(content, imu_ns=content.imu_ns[keep], accel_gyro=values[keep])
    recording = open_recording(write_folder(gappy, tmp_path / "room"))
    events = list(EventStream(recording))
    flags = np.concatenate([e.is_saturated for e in events if isinstance(e, protocol.ImuBatch)])
    assert np.flatnonzero(flags).tolist() == [5, 6]
    report = summary.summarise(recording)
    assert report.imu is not None
    assert (report.imu.gaps, report.imu.saturated_samples) == (1, 2)
    assert report.imu.largest_interval_s == pytest.approx(0.105)
    assert report.imu.first_gap_s == pytest.approx(29 * 0.005)
    assert any("longer than 0.05 s" in note for note in report.notes)
    relaxed = summary.summarise(recording, StreamOptions(imu_gap_s=0.2))
    assert relaxed.imu is not None
    assert relaxed.imu.gaps == 0


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def _flip(path: Path) -> None:
    """Change a byte in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


CAM = f"mav0/cam1/data/{START_NS + 1000 + 50_000_000}.png"
DAMAGES = {
    "missing image": (
        lambda f: (f / CAM).unlink(),
        r"\.png: the image is missing \(1 of 8 in cam1\)",
    ),
    "truncated image": (lambda f: _truncate(f / CAM), r"\.png: the image is truncated"),
    "empty image": (lambda f: (f / CAM).write_bytes(b""), r"\.png: the image is empty"),
    "damaged image": (lambda f: _flip(f / CAM), r"\.png: the image is damaged"),
    "no image": (lambda f: (f / CAM).write_bytes(b"text" * 99), "neither a PNG nor a JPEG"),
    "other size": (
        lambda f: _edit(f / "mav0/cam1/sensor.yaml", "[64, 48]", "[64, 50]"),
        r"the image is 64 x 48, the calibration is of 64 x 50: calibrate",
    ),
    "no image folder": (lambda f: shutil.rmtree(f / "mav0/cam0/data"), "copy the images there"),
    "no image table": (lambda f: (f / "mav0/cam0/data.csv").unlink(), r"cam0/data\.csv: No such"),
    "bad image row": (
        lambda f: _edit(f / "mav0/cam0/data.csv", f"\n{START_NS},", "\nsoon,"),
        r"cam0/data\.csv:2: 'soon' is not a time stamp",
    ),
    "image elsewhere": (
        lambda f: _edit(f / "mav0/cam0/data.csv", f"{START_NS}.png", "../../secret.png"),
        r"cam0/data\.csv:2: a row must be",
    ),
    "no images": (
        lambda f: (f / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n"),
        "the recording is empty",
    ),
    "no IMU table": (lambda f: (f / "mav0/imu0/data.csv").unlink(), "imu0/data.csv: the table is"),
    "no samples": (lambda f: (f / "mav0/imu0/data.csv").write_text("#t\n"), "there are no rows"),
    "no calibration": (
        lambda f: [p.unlink() for p in f.rglob("sensor.yaml")],
        "there is no calibration .*--sensor_calibration_file",
    ),
    "a calibration beside it": (
        lambda f: [(f / "chain.yaml").touch(), *(p.unlink() for p in f.rglob("sensor.yaml"))],
        r"--sensor_calibration_file.*perhaps one of .*chain\.yaml",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_folders_are_refused_in_one_line(folder: Path, damage: str) -> None:
    harm, message = DAMAGES[damage]
    harm(folder)
    with pytest.raises(MapError) as caught:
        summary.summarise(open_recording(folder), check_images=True)
    text = str(caught.value)
    assert re.search(message, text), text
    assert "\n" not in text
    assert str(folder) in text


def test_decoding_refuses_what_the_check_refuses(folder: Path) -> None:
    _truncate(folder / CAM)
    sets = frame_sets(list(EventStream(open_recording(folder))))
    assert sets[1].images[0].decode().shape == (48, 64)
    with pytest.raises(MapError, match="truncated"):
        sets[1].images[1].decode()


def test_a_calibration_with_more_cameras_than_the_folder(folder: Path) -> None:
    file = write_calibration(open_recording(folder).device, folder / "sensors.yaml")
    shutil.rmtree(folder / "mav0" / "cam1")
    with pytest.raises(MapError, match=r"cam1: the folder is missing.*--rovio_active_camera_ind"):
        open_recording(folder, SourceOptions(sensor_calibration_file=file))
    first = SourceOptions(sensor_calibration_file=file, rovio_active_camera_indices="0")
    assert len(frame_sets(list(EventStream(open_recording(folder, first))))) == 8


def test_a_truncated_jpeg_is_refused(tmp_path: Path) -> None:
    folder = write_folder(make_content(), tmp_path / "room", suffix=".jpg")
    assert summary.summarise(open_recording(folder), check_images=True).checked_images == 16
    _truncate((folder / CAM).with_suffix(".jpg"))
    with pytest.raises(MapError, match=r"\.jpg: the image is truncated"):
        summary.summarise(open_recording(folder), check_images=True)


def test_what_is_no_recording(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not exist"):
        open_recording(tmp_path / "absent")
    with pytest.raises(UserError, match="is no recording: wants a folder with mav0/cam0"):
        open_recording(tmp_path)


def test_real_stereo_recording() -> None:
    folder = shared_data("euroc_mh01_10s")
    recording = open_recording(folder)
    events = list(EventStream(recording))
    assert_in_order(events)
    sets = frame_sets(events)
    assert len(sets) == 200
    assert (sets[0].time_ns, sets[-1].time_ns) == (1403636584763555584, 1403636594713555456)
    assert all(image.stamp_ns == s.time_ns for s in sets for image in s.images)
    times_ns, accel_gyro = samples(events)
    assert len(times_ns) == 2111
    assert times_ns[0] == 1403636584263555584
    assert accel_gyro[0, 0] == 10.133538333333334
    assert sets[7].images[1].grey().shape == (480, 752)
    report = summary.summarise(recording, check_images=True)
    assert (report.checked_images, report.frame_sets, report.dropped_before_imu) == (400, 200, 0)
    assert report.imu is not None
    assert report.imu.rate_hz == pytest.approx(200.0, abs=0.01)
    assert report.imu.gaps == 0
    baseline_m = np.linalg.norm(se3.relative(*recording.device.T_I_C)[4:])
    assert baseline_m == pytest.approx(0.1101, abs=1e-4)


def test_real_irregular_keyframes_without_imu() -> None:
    recording = open_recording(shared_data("euroc_v101_keyframes"))
    events = list(EventStream(recording))
    assert len(frame_sets(events)) == len(events) == 50
    steps_s = np.diff([event.time_ns for event in events]) * 1e-9
    assert steps_s.min() < 1.0 < 7.0 < steps_s.max() < 7.5
    report = summary.summarise(recording)
    assert report.imu is None
    assert report.notes == ("there is no IMU",)


def _counts_and_memory(folder: Path) -> tuple[int, int, int, int]:
    """Read a folder to its end, every 100th image too.

    Returns:
        Frame sets and IMU samples, memory in use at the end and its peak [bytes].
    """
    stream = EventStream(open_recording(folder))
    tracemalloc.start()
    for event in stream:
        if isinstance(event, protocol.FrameSet) and stream.statistics.frame_sets.count % 100 == 0:
            assert event.images[1].grey().shape == (480, 752)
    now, peak = tracemalloc.get_traced_memory()
    return stream.statistics.frame_sets.count, stream.statistics.imu.count, now, peak


@pytest.mark.slow
def test_ten_minutes_of_stereo_are_never_held_at_once(tmp_path: Path) -> None:
    frames, content = 12_000, make_content(frames=1)
    imu_ns = START_NS + np.arange(120_000) * 5_000_000
    long = dataclasses.replace(
        content, imu_ns=imu_ns, accel_gyro=np.random.default_rng(1).normal(size=(120_000, 6))
    )
    folder = write_folder(long, tmp_path / "long")
    stamps = START_NS + np.arange(frames) * 50_000_000
    big = np.random.default_rng(0).integers(0, 255, (480, 752), dtype=np.uint8)
    size = 2 * frames * big.nbytes
    cv2.imwrite(str(tmp_path / "big.png"), big)
    for camera in (0, 1):
        home = folder / "mav0" / f"cam{camera}"
        _edit(home / "sensor.yaml", "[64, 48]", "[752, 480]")
        rows = "".join(f"{stamp},a{row % 50}.png\n" for row, stamp in enumerate(stamps.tolist()))
        (home / "data.csv").write_text(rows)
        for row in range(50):
            (home / "data" / f"a{row}.png").symlink_to(tmp_path / "big.png")
    sets, samples, now, peak = in_own_process(_counts_and_memory, folder)
    assert (sets, samples) == (frames, 120_000)
    assert peak < size / 30, peak  # while the table of the IMU is read
    assert now < 30e6, now
