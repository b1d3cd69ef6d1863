"""Bags of other recorders: topics, spellings, metadata, compression; each failure with its remedy."""

import dataclasses
import shutil
import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.listing import bag_info
from maplab_py.interop.recordings import stream, summary
from maplab_py.interop.recordings.options import SourceOptions, StreamOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from tests.interop.recordings import written

typesys = pytest.importorskip("rosbags.typesys")
Stores, get_typestore = typesys.Stores, typesys.get_typestore

CONTENT = written.make_content(frames=4)
MCAP, DATA_END = b"\x89MCAP0\r\n", 0x0F


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> SourceOptions:
    folder = tmp_path_factory.mktemp("device")
    device = open_recording(
        written.write_folder(written.make_content(frames=1), folder / "room")
    ).device
    return SourceOptions(
        sensor_calibration_file=written.write_calibration(device, folder / "sensors.yaml")
    )


def bag(tmp_path: Path, storage: str = "sqlite3") -> Path:
    return written.write_bag(CONTENT, tmp_path / "room", version=2, storage=storage)


def assert_reads(path: Path, calibrated: SourceOptions) -> None:
    written.assert_content(list(stream.EventStream(open_recording(path, calibrated))), CONTENT)


def database(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path / "room.db3")


@pytest.mark.parametrize(
    ("kind", "encoding", "definition"),
    [
        ("odd_msgs/msg/Odd", "ros2msg", "no definition at all : {"),
        ("odd_msgs/msg/Odd", "ros2msg", ""),
        ("odd_msgs/msg/Odd", "unknown", "?"),
        ("odd_msgs/msg/Odd", "ros2msg", "other_msgs/Missing part\n"),
        ("sensor_msgs/msg/NavSatFix", "ros2msg", "uint8 version\nstring other\n"),
        ("sensor_msgs/msg/Imu", "ros2msg", "float32 only\n"),
        ("Odd", "jsonschema", "{}"),
    ],
)
def test_topics_that_nobody_asked_for(
    tmp_path: Path, calibrated: SourceOptions, kind: str, encoding: str, definition: str
) -> None:
    path = bag(tmp_path)
    with database(path) as data:
        data.execute("DELETE FROM message_definitions WHERE topic_type = ?", (kind,))
        data.execute(
            "INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, "
            "type_description_hash) VALUES (?, ?, ?, 'x')",
            (kind, encoding, definition),
        )
        data.execute("INSERT INTO topics VALUES (99, '/odd', ?, 'json', '{bad: [', 'y')", (kind,))
        data.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (99, 5, 'text')")
    assert_reads(path, calibrated)
    assert "/odd" in [topic.topic for topic in bag_info(path).topics]


def test_binary_definitions_of_topics_that_nobody_asked_for(
    tmp_path: Path, calibrated: SourceOptions
) -> None:
    file = bag(tmp_path, "mcap") / "room.mcap"
    data, place = file.read_bytes(), len(MCAP)
    while data[place] != DATA_END:
        place += 9 + struct.unpack_from("<Q", data, place + 1)[0]
    text = [
        struct.pack("<I", len(word)) + word
        for word in (b"odd.Odd", b"protobuf", b"\n\xff\xc3\0", b"/odd")
    ]
    records = [
        (0x03, struct.pack("<H", 99) + b"".join(text[:3])),
        (0x04, struct.pack("<HH", 99, 99) + text[3] + text[1] + bytes(4)),
        (0x05, struct.pack("<HIQQ", 99, 0, 1 << 62, 1 << 62) + b"\xff\xfe"),
        *((DATA_END, bytes(4)), (0x02, bytes(20))),
    ]
    more = b"".join(struct.pack("<BQ", code, len(body)) + body for code, body in records)
    file.write_bytes(data[:place] + more + MCAP)
    assert_reads(file, calibrated)
    kinds = {topic.topic: topic.type for topic in bag_info(file).topics}
    assert kinds["/odd"] == "odd.Odd"


def test_both_spellings_of_types(tmp_path: Path, calibrated: SourceOptions) -> None:
    path = bag(tmp_path)
    with database(path) as data:
        data.execute("UPDATE topics SET type = replace(type, '/msg/', '/')")
        data.execute("DELETE FROM message_definitions")
    assert_reads(path, calibrated)
    assert {t.type for t in bag_info(path).topics} == {
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/Image",
    }


def test_an_old_schema(tmp_path: Path, calibrated: SourceOptions) -> None:
    path = bag(tmp_path)
    with database(path) as data:
        data.execute("DROP TABLE schema")
        data.execute("DROP TABLE message_definitions")
        data.execute("ALTER TABLE topics DROP COLUMN offered_qos_profiles")
        data.execute("ALTER TABLE topics DROP COLUMN type_description_hash")
    assert_reads(path / "room.db3", calibrated)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", None),
        ("storage_identifier: sqlite3", "storage_identifier: ''"),
        ("storage_identifier: mcap", "storage_identifier:"),
        ("version: 9", "version: 11"),
        ("serialization_format: cdr", "serialization_format: odd"),
        ("topics_with_message_count", "other"),
    ],
)
def test_metadata_that_are_missing_or_odd(
    tmp_path: Path, calibrated: SourceOptions, storage: str, old: str, new: str | None
) -> None:
    path = bag(tmp_path, storage)
    metadata = path / "metadata.yaml"
    if new is None:
        metadata.unlink()
    else:
        metadata.write_text(metadata.read_text().replace(old, new))
    assert_reads(path, calibrated)


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("has_metadata", [True, False])
def test_compressed_files(
    tmp_path: Path, calibrated: SourceOptions, storage: str, has_metadata: bool
) -> None:
    zstd = pytest.importorskip("backports.zstd")
    path = bag(tmp_path, storage)
    file = path / f"room.{'db3' if storage == 'sqlite3' else 'mcap'}"
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    if not has_metadata:
        (path / "metadata.yaml").unlink()
    assert_reads(path, calibrated)
    assert_reads(packed, calibrated)
    packed.write_bytes(packed.read_bytes()[:-50])
    with pytest.raises(MapError, match="copy it again"):
        open_recording(path, calibrated)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", ["room.bag", "ROOM.BAG", "room.DB3", "room.mcap"])
def test_files_with_other_endings(
    tmp_path: Path, calibrated: SourceOptions, version: int, name: str
) -> None:
    path = written.write_bag(
        CONTENT, tmp_path / ("a.bag" if version == 1 else "a"), version=version
    )
    file = path if version == 1 else path / "a.db3"
    assert_reads(file.rename(tmp_path / name), calibrated)
    assert bag_info(tmp_path / name).format == ("ros1" if version == 1 else "sqlite3")


@pytest.mark.parametrize("has_metadata", [True, False])
def test_messages_that_are_compressed_one_by_one(
    tmp_path: Path, calibrated: SourceOptions, has_metadata: bool
) -> None:
    zstd = pytest.importorskip("backports.zstd")
    path = bag(tmp_path)
    with database(path) as data:
        for key, content in data.execute("SELECT id, data FROM messages").fetchall():
            data.execute("UPDATE messages SET data = ? WHERE id = ?", (zstd.compress(content), key))
    if not has_metadata:
        (path / "metadata.yaml").unlink()
    assert_reads(path, calibrated)


def test_several_files_without_metadata(tmp_path: Path, calibrated: SourceOptions) -> None:
    path = bag(tmp_path)
    (path / "metadata.yaml").unlink()
    shutil.copy(path / "room.db3", path / "a_second.db3")
    middle = CONTENT.imu_ns[len(CONTENT.imu_ns) // 2].item()
    with database(path) as data:
        data.execute("DELETE FROM messages WHERE timestamp >= ?", (middle,))
    with sqlite3.connect(path / "a_second.db3") as data:
        data.execute("DELETE FROM messages WHERE timestamp < ?", (middle,))
    assert_reads(path, calibrated)


def test_rows_of_images_without_a_step(tmp_path: Path, calibrated: SourceOptions) -> None:
    assert_reads(image_bag(tmp_path, step=0), calibrated)


@pytest.mark.parametrize(
    ("encoding", "words"),
    [("32FC1", "are depths"), ("", "are unknown"), ("bayer_rggb12p", "are unknown")],
)
def test_images_that_cannot_be_read_are_noted(
    tmp_path: Path, calibrated: SourceOptions, encoding: str, words: str
) -> None:
    path = image_bag(tmp_path, encoding=encoding)
    notes = summary.summarise(open_recording(path, calibrated)).notes
    assert len(notes) == 2  # of two cameras
    for row, note in enumerate(notes):
        assert f"/cam{row}/image_raw at" in note
        assert f"'{encoding}' {words}" in note


def test_videos_are_noted_and_converted_encodings_named(
    tmp_path: Path, calibrated: SourceOptions
) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    video = store.types["sensor_msgs/msg/CompressedImage"]
    messages = [
        (t, "/imu0", written.imu_message(store, t, values, 1))
        for t, values in zip(CONTENT.imu_ns.tolist(), CONTENT.accel_gyro, strict=True)
    ]
    for t, image in zip(CONTENT.stamps_ns[0].tolist(), CONTENT.images[0], strict=True):
        header = written.image_message(store, t, image, "mono8", 1).header
        packet = np.frombuffer(b"\0\0\0\1gB" * 9, dtype=np.uint8)
        messages.append((t, "/cam0/image_raw", video(header, "h264", packet)))
        mosaic = written.image_message(store, t, image, "bayer_rggb8", 1)
        messages.append((t, "/cam1/image_raw", mosaic))
    written.write_messages(tmp_path / "v.bag", store, sorted(messages, key=lambda entry: entry[:2]))
    assert [topic.encoding for topic in bag_info(tmp_path / "v.bag").images] == [
        "h264",
        "bayer_rggb8",
    ]
    wide = StreamOptions(nframe_sync_tolerance_ns=1_000_000)
    notes = summary.summarise(open_recording(tmp_path / "v.bag", calibrated), wide).notes
    assert notes[0] == "images are converted: camera 1 bayer_rggb8"
    assert "/cam0/image_raw at" in notes[1]
    assert "'h264' is a video" in notes[1]


def image_bag(tmp_path: Path, **changes: object) -> Path:
    """A bag of unpadded images with changed fields."""
    store = get_typestore(Stores.ROS1_NOETIC)
    stamps = CONTENT.imu_ns.tolist()
    messages = [
        (t, "/imu0", written.imu_message(store, t, values, 1))
        for t, values in zip(stamps, CONTENT.accel_gyro, strict=True)
    ]
    for camera in (0, 1):
        for t, image in zip(
            CONTENT.stamps_ns[camera].tolist(), CONTENT.images[camera], strict=True
        ):
            message = written.image_message(store, t, image, "mono8", 1, padding=0)
            changed = dataclasses.replace(message, **changes)
            messages.append((t, f"/cam{camera}/image_raw", changed))
    messages.sort(key=lambda entry: entry[:2])
    written.write_messages(tmp_path / "a.bag", store, messages)
    return tmp_path / "a.bag"


def test_folders_of_bags_and_open_bags_are_told(tmp_path: Path, calibrated: SourceOptions) -> None:
    path = bag(tmp_path)
    with pytest.raises(UserError, match=f"it holds {path}$"):
        open_recording(tmp_path, calibrated)
    recorded = written.write_bag(CONTENT, tmp_path / "b.bag").rename(tmp_path / "b.bag.active")
    with pytest.raises(UserError, match=r"run `rosbag reindex \S*b.bag.active`"):
        open_recording(recorded, calibrated)


def test_each_failure_names_its_remedy(tmp_path: Path, calibrated: SourceOptions) -> None:
    mcap = bag(tmp_path, "mcap")
    file = mcap / "room.mcap"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(MapError, match=r"`mcap recover \S*room.mcap -o whole.mcap`"):
        open_recording(mcap, calibrated)
    file.write_text("version https://git-lfs.github.com/spec/v1\nsize 5\n")
    with pytest.raises(MapError, match=r"it is text, 'version https://git-lfs.*': fetch the bag"):
        open_recording(file, calibrated)
    shutil.rmtree(mcap)
    path = bag(tmp_path)
    (path / "room.db3").rename(path / "other.db3")
    with pytest.raises(MapError, match=r"room.db3 of its metadata.yaml is missing"):
        open_recording(path, calibrated)
    shutil.rmtree(path)
    unclosed = written.write_bag(CONTENT, tmp_path / "room.bag")
    data = bytearray(unclosed.read_bytes())
    place = data.index(b"index_pos=") + len(b"index_pos=")
    data[place : place + 8] = bytes(8)
    unclosed.write_bytes(data)
    with pytest.raises(MapError, match=r"not closed: run `rosbag reindex \S*room.bag`"):
        open_recording(unclosed, calibrated)
