"""Resources of bags; bags that are damaged or hold messages of unknown types."""

import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags import exporting, listing, poses
from maplab_py.interop.bags.importing import import_bag_resources
from maplab_py.interop.bags.options import BagExportOptions, BagImportOptions
from maplab_py.interop.bags.sensor_messages import CLOUD, COMPRESSED, IMAGE, MessageMaker
from maplab_py.interop.ply import PlyCloud
from maplab_py.interop.recordings.bag_files import message_types, opened_bag
from maplab_py.interop.recordings.bag_writing import (
    BagFormat,
    BagMessage,
    Channel,
    bag_files,
    write_bag,
)
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import VIMap
from tests.interop.bags import small_bags
from tests.interop.recordings.written import image_message
from tests.interop.small_map import IMU_ID, VERTICES, make_map

pytest.importorskip("rosbags")

from rosbags.typesys import get_types_from_msg

LEFT = BagImportOptions(resource_topic="/left/image_raw")
ROS1 = MessageMaker(is_ros_2=False)


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_what_was_exported_comes_back(tmp_path: Path, kind: BagFormat) -> None:
    before, _, _ = small_bags.map_with_resources()
    path = small_bags.named(tmp_path, kind)
    exporting.export_bag(before, tmp_path, 0, path, BagExportOptions(format=kind.value))
    bare = small_bags.with_time_offset(make_map())
    vi_map = bare
    for options in (
        BagImportOptions("left/image_raw", camera_calibration_topic="/cam0/camera_info"),
        BagImportOptions("/cam0/depth"),
        BagImportOptions("/points0", sensor_id=IMU_ID[:6]),
    ):
        vi_map, report = import_bag_resources(vi_map, 0, path, options)
        assert report.attached == report.messages
        if options.camera_calibration_topic:
            assert report.calibration_difference_px is not None
            assert report.calibration_difference_px < 1e-6
    assert len(bare.resources) == 0
    table, expected = vi_map.resources, before.resources
    for name in ("type", "owner", "owner_kind", "sensor_id", "timestamp_ns"):
        np.testing.assert_array_equal(getattr(table, name), getattr(expected, name))
    stores = ResourceStore(vi_map, tmp_path), ResourceStore(before, tmp_path)
    for row in range(len(table)):
        read, written = (store.load(row) for store in stores)
        np.testing.assert_array_equal(np.asarray(read), np.asarray(written))


def test_what_is_there_stays(tmp_path: Path) -> None:
    vi_map, _, _ = small_bags.map_with_resources()
    exporting.export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    for options in (LEFT, BagImportOptions("/points0", sensor_id=IMU_ID)):
        again, report = import_bag_resources(vi_map, 0, tmp_path / "walk.bag", options)
        assert again is vi_map
        assert (report.attached, report.had_some) == (0, report.messages)


def write_images(
    path: Path,
    stamps: list[int],
    messages: list[bytes],
    kind: str = IMAGE,
    topic: str = "/left/image_raw",
) -> Path:
    channel = Channel(topic, kind)
    arrivals = range(10**9, 10**9 + len(stamps))
    write_bag(
        path,
        BagFormat.ROS1,
        (BagMessage(t, channel, data) for t, data in zip(arrivals, messages, strict=True)),
    )
    return path


def image_bag(path: Path, vi_map: VIMap, shift_ns: int = 0, **changes: Any) -> Path:
    """Write grey images of the first mission at the times of the camera's clock."""
    stamps = (vi_map.vertices.timestamp_ns[:VERTICES] - small_bags.OFFSET_NS + shift_ns).tolist()
    pixels = changes.get("pixels", np.full((480, 640), 80, dtype=np.uint8))
    return write_images(path, stamps, [ROS1.image(t, "left", pixels) for t in stamps])


def test_the_time_offset_is_added(tmp_path: Path) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    path = image_bag(tmp_path / "late.bag", vi_map, shift_ns=40_000_000)
    with pytest.raises(UserError, match=r"no message is within --image_tolerance_ms=1 .*offset_ns"):
        import_bag_resources(vi_map, 0, path, LEFT)
    options = BagImportOptions("/left/image_raw", resource_time_offset_ns=-40_000_000)
    attached, report = import_bag_resources(vi_map, 0, path, options)
    assert report.attached == VERTICES
    np.testing.assert_array_equal(attached.resources.owner, np.arange(VERTICES))
    clouds = tmp_path / "clouds.bag"
    with_clouds, _, _ = small_bags.map_with_resources()
    exporting.export_bag(with_clouds, tmp_path, 0, clouds)
    options = BagImportOptions("/points0", resource_time_offset_ns=1000, sensor_id=IMU_ID)
    attached, _ = import_bag_resources(vi_map, 0, clouds, options)
    expected = vi_map.vertices.timestamp_ns[:3] + 1007
    np.testing.assert_array_equal(attached.resources.timestamp_ns, expected)


def test_colours_and_sixteen_bits(tmp_path: Path) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    colours = np.random.default_rng(1).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    path = image_bag(tmp_path / "colour.bag", vi_map, pixels=colours)
    attached, report = import_bag_resources(vi_map, 0, path, LEFT)
    assert report.resource_types == ("raw_color_images",)
    np.testing.assert_array_equal(ResourceStore(attached, tmp_path).load(0), colours)


def depth_message(stamp: int, depth_m: np.ndarray, form: str) -> tuple[str, bytes]:
    """Return type and bytes of a depth image of ROS 1."""
    store = message_types(is_ros_2=False)
    if form == "16UC1":
        return IMAGE, ROS1.image(stamp, "left", np.round(1000 * depth_m).astype(np.uint16))
    if form == "compressedDepth":
        message = image_message(store, stamp, np.round(1000 * depth_m).astype(np.uint16), "png", 1)
        message.format = "16UC1; compressedDepth png"
        message.data = np.concatenate([np.zeros(12, dtype=np.uint8), message.data])
        return COMPRESSED, bytes(store.serialize_ros1(message, COMPRESSED))
    message = image_message(store, stamp, depth_m.astype(np.float32), "32FC1", 1, padding=8)
    return IMAGE, bytes(store.serialize_ros1(message, IMAGE))


@pytest.mark.parametrize("form", ["16UC1", "32FC1", "compressedDepth"])
def test_depth_in_millimetres_and_metres(tmp_path: Path, form: str) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    depth_m = np.linspace(0.0, 9.0, 480 * 640).reshape(480, 640)
    if form == "32FC1":
        depth_m[0, :5] = np.nan
    stamp = int(vi_map.vertices.timestamp_ns[1]) - small_bags.OFFSET_NS
    kind, data = depth_message(stamp, depth_m, form)
    path = write_images(tmp_path / "depth.bag", [stamp], [data], kind)
    attached, report = import_bag_resources(vi_map, 0, path, LEFT)
    assert (report.resource_types, report.attached) == (("raw_depth_maps",), 1)
    assert attached.resources.owner.tolist() == [1]
    expected = np.round(1000 * np.nan_to_num(depth_m.astype(np.float32))).astype(np.uint16)
    read = ResourceStore(attached, tmp_path).load(0)
    assert np.abs(read.astype(np.int64) - expected).max() <= 1


def test_wrong_units_of_depth_are_refused(tmp_path: Path) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    stamp = int(vi_map.vertices.timestamp_ns[1]) - small_bags.OFFSET_NS
    kind, data = depth_message(stamp, np.full((480, 640), 2500.0), "32FC1")
    path = write_images(tmp_path / "depth.bag", [stamp], [data], kind)
    with pytest.raises(MapError, match=r"depth\.bag.* 32FC1 is in metres; record millimetres"):
        import_bag_resources(vi_map, 0, path, LEFT)


def other_size(vi_map: VIMap) -> VIMap:
    return small_bags.with_camera(vi_map, width_px=600)


def other_focal_length(vi_map: VIMap) -> VIMap:
    return small_bags.with_camera(vi_map, intrinsics=np.array([260.0, 251.0, 320.0, 240.0]))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (other_size, "600 x 480"),
        (other_focal_length, "differs from that of the map's camera by up"),
    ],
)
def test_a_calibration_of_another_camera_is_refused(
    tmp_path: Path, change: Callable[[VIMap], VIMap], problem: str
) -> None:
    exporting.export_bag(small_bags.map_with_resources()[0], tmp_path, 0, tmp_path / "walk.bag")
    vi_map = change(small_bags.with_time_offset(make_map()))
    options = BagImportOptions("/left/image_raw", camera_calibration_topic="/cam0/camera_info")
    with pytest.raises(UserError, match=f"walk.bag: /cam0/camera_info: .*{problem}.*--camera"):
        import_bag_resources(vi_map, 0, tmp_path / "walk.bag", options)


def test_wrong_topics_and_bags_are_refused(tmp_path: Path) -> None:
    vi_map, _, _ = small_bags.map_with_resources()
    path = tmp_path / "walk.bag"
    exporting.export_bag(vi_map, tmp_path, 0, path)

    def refused(problem: str, kind: type[Exception] = UserError, **options: Any) -> None:
        bag = options.pop("path", path)
        with pytest.raises(kind, match=problem) as error:
            import_bag_resources(vi_map, 0, bag, BagImportOptions(**options))
        assert "\n" not in str(error.value)
        assert str(bag) in str(error.value) or "--" in str(error.value)

    refused("no topic is given: give --resource_topic; the bag has /cam0/depth .sensor_msgs")
    refused("there is no topic /none", resource_topic="/none")
    refused("/pose has messages of type geometry_msgs/msg/PoseStamped", resource_topic="/pose")
    refused("--camera=3: the mission has cameras 0 to 0", resource_topic="/cam0/depth", camera=3)
    refused("the mission has no lidar", resource_topic="/points0")
    calibration = {"camera_calibration_topic": "/cam0/camera_info"}
    refused("is for images", resource_topic="/points0", **calibration)
    calibration = {"camera_calibration_topic": "/pose"}
    refused(
        "/pose has messages of type .* give --camera_calibration_topic",
        resource_topic="/cam0/depth",
        **calibration,
    )
    refused("gone.bag does not exist", path=tmp_path / "gone.bag", resource_topic="/a")
    cut = tmp_path / "cut.bag"
    cut.write_bytes(path.read_bytes()[:-3000])
    refused(r"cut\.bag: the bag cannot be read", MapError, path=cut, resource_topic="/cam0/depth")


def test_an_empty_cloud_does_not_stop_the_others(tmp_path: Path) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    stamps = vi_map.vertices.timestamp_ns[:4].tolist()
    places = [np.eye(3), np.zeros((0, 3)), np.full((2, 3), np.nan), 2.0 * np.eye(3)]
    data = [ROS1.cloud(t, "lidar", PlyCloud(p)) for t, p in zip(stamps, places, strict=True)]
    path = write_images(tmp_path / "clouds.bag", stamps, data, CLOUD)
    options = BagImportOptions("/left/image_raw", sensor_id=IMU_ID)
    attached, report = import_bag_resources(vi_map, 0, path, options)
    assert (report.attached, report.had_some) == (2, 0)
    assert report.notes == ("2 clouds without finite points left out",)
    assert attached.resources.timestamp_ns.tolist() == [stamps[0], stamps[3]]
    path = write_images(tmp_path / "none.bag", stamps[1:3], data[1:3], CLOUD)
    with pytest.raises(MapError, match="the cloud is empty"):
        import_bag_resources(vi_map, 0, path, options)


def test_damaged_messages_are_refused(tmp_path: Path) -> None:
    vi_map = small_bags.with_time_offset(make_map())
    stamps = (vi_map.vertices.timestamp_ns[:2] - small_bags.OFFSET_NS).tolist()
    pixels = np.zeros((480, 640), dtype=np.uint8)
    images = [ROS1.image(t, "left", pixels) for t in stamps]

    def refused(problem: str, name: str, kind: str, stamps: list[int], data: list[bytes]) -> None:
        path = write_images(tmp_path / name, stamps, data, kind)
        options = BagImportOptions("/left/image_raw", sensor_id=IMU_ID)
        with pytest.raises(MapError, match=problem) as error:
            import_bag_resources(vi_map, 0, path, options)
        assert str(path) in str(error.value)

    refused("does not come after", "unsorted.bag", IMAGE, stamps[::-1], images[::-1])
    refused("the bag cannot be read", "short.bag", IMAGE, stamps, [i[:5000] for i in images])
    refused("the bag cannot be read", "empty.bag", IMAGE, stamps, [b"", b""])
    small = [ROS1.image(t, "left", pixels[:100]) for t in stamps]
    refused("640 x 100|100", "small.bag", IMAGE, stamps, small)
    store = message_types(is_ros_2=False)
    done, data = cv2.imencode(".png", pixels)
    assert done
    message = image_message(store, stamps[0], pixels, "png", 1)
    message.data = data.reshape(-1)[:300]
    cut = [bytes(store.serialize_ros1(message, COMPRESSED))]
    refused("truncated", "png.bag", COMPRESSED, stamps[:1], cut)
    inside = stamps[0] + small_bags.OFFSET_NS + 10
    far = ROS1.cloud(inside, "lidar", PlyCloud(2500.0 * np.eye(3)))
    refused("coordinates are in metres", "far.bag", CLOUD, stamps[:1], [far])
    cloud = ROS1.cloud(inside, "lidar", PlyCloud(np.eye(3)))
    broken = [cloud.replace(b"x\x00\x00\x00\x00\x07", b"q\x00\x00\x00\x00\x07")]
    refused("has no x, y, z", "cloud.bag", CLOUD, stamps[:1], broken)


pytest.importorskip("rosbags")

CONTENT = "poses,tf,imu"
POSES = BagImportOptions("/points0", sensor_id=IMU_ID)


@pytest.fixture
def vi_map() -> VIMap:
    return small_bags.with_time_offset(make_map())


def tried(path: Path, vi_map: VIMap, target: Path) -> list[str]:
    """Use a bag in every way; return what was refused."""
    problems = []
    for use in (
        lambda: listing.bag_info(path),
        lambda: poses.add_poses_to_bag(vi_map, path, target),
        lambda: import_bag_resources(vi_map, 0, path, POSES),
    ):
        try:
            use()
        except (MapError, UserError) as error:
            problems.append(str(error))
    assert [problem for problem in problems if "\n" in problem or path.stem not in problem] == []
    return problems


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_cut_bags(tmp_path: Path, kind: BagFormat, vi_map: VIMap) -> None:
    path = small_bags.named(tmp_path, kind)
    exporting.export_bag(vi_map, tmp_path, 0, path, BagExportOptions(kind.value, CONTENT))
    whole = bag_files(path, kind)[0].read_bytes()
    for number, length in enumerate(np.linspace(0, len(whole) - 1, 12).astype(int).tolist()):
        damaged = small_bags.named(tmp_path, kind, f"cut{number}")
        if kind.is_ros_2:
            shutil.copytree(path, damaged)
            (damaged / path.name).with_suffix(bag_files(path, kind)[0].suffix).write_bytes(
                whole[:length]
            )
        else:
            damaged.write_bytes(whole[:length])
        problems = tried(damaged, vi_map, small_bags.named(tmp_path, kind, f"out{number}"))
        assert len(problems) == 3, length
        assert not small_bags.named(tmp_path, kind, f"out{number}").exists()


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_changed_bags(tmp_path: Path, kind: BagFormat, vi_map: VIMap) -> None:
    rng = np.random.default_rng(7)
    path = small_bags.named(tmp_path, kind)
    exporting.export_bag(vi_map, tmp_path, 0, path, BagExportOptions(kind.value, CONTENT))
    whole = bag_files(path, kind)[0].read_bytes()
    for number in range(15):
        data = np.frombuffer(whole, dtype=np.uint8).copy()
        data[rng.integers(0, len(data), 40)] = rng.integers(0, 256, 40)
        bag_files(path, kind)[0].write_bytes(data.tobytes())
        tried(path, vi_map, small_bags.named(tmp_path, kind, f"out{number}"))


def test_a_folder_without_its_file(tmp_path: Path, vi_map: VIMap) -> None:
    exporting.export_bag(vi_map, tmp_path, 0, tmp_path / "walk", BagExportOptions(content=CONTENT))
    (tmp_path / "walk" / "walk.mcap").unlink()
    with pytest.raises(MapError, match="walk: the bag cannot be read"):
        listing.bag_info(tmp_path / "walk")
    (tmp_path / "walk" / "metadata.yaml").write_text(
        "- !!python/object/apply:os.system [touch x]\n"
    )
    with pytest.raises(MapError, match="walk: the bag cannot be read"):
        listing.bag_info(tmp_path / "walk")


ODD = "odd_msgs/msg/Odd"


def odd_bag(path: Path, kind: BagFormat) -> Path:
    """Write a bag whose messages have a type of their own."""
    store = message_types(is_ros_2=kind.is_ros_2)
    store.register(get_types_from_msg("uint32 number\nstring text\n", ODD))
    definition, md5 = store.generate_msgdef(ODD, ros_version=2 if kind.is_ros_2 else 1)
    digest = store.hash_rihs01(ODD) if kind.is_ros_2 else md5
    channel = Channel("/odd", ODD, definition, digest)
    message = store.types[ODD](7, "seven")
    serialize = store.serialize_cdr if kind.is_ros_2 else store.serialize_ros1
    data = bytes(serialize(message, ODD))
    write_bag(path, kind, [BagMessage(time_ns, channel, data) for time_ns in (10, 20)])
    return path


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_unknown_types_are_listed_and_copied(tmp_path: Path, kind: BagFormat) -> None:
    source = odd_bag(small_bags.named(tmp_path, kind, "odd"), kind)
    (topic,) = listing.bag_info(source).topics
    assert (topic.topic, topic.type, topic.messages) == ("/odd", ODD, 2)
    target = small_bags.named(tmp_path, kind, "out")
    poses.add_poses_to_bag(make_map(), source, target, missions=np.array([0]))
    with opened_bag(target) as reader:
        (connection,) = [c for c in reader.connections if c.topic == "/odd"]
        read = [reader.deserialize(data, ODD) for _, _, data in reader.messages([connection])]
    assert [(message.number, message.text) for message in read] == [(7, "seven")] * 2
    with pytest.raises(UserError, match=f"/odd has messages of type {ODD}"):
        import_bag_resources(make_map(), 0, source, BagImportOptions("/odd"))


def test_types_without_definition_are_refused_by_name(tmp_path: Path) -> None:
    source = odd_bag(tmp_path / "odd", BagFormat.SQLITE3)
    with sqlite3.connect(source / "odd.db3") as database:
        database.execute("UPDATE message_definitions SET encoding = 'unknown'")
        database.execute("DELETE FROM message_definitions")
        database.execute("UPDATE topics SET type_description_hash = ''")
    with pytest.raises(MapError, match=f"odd.*{ODD}") as error:
        poses.add_poses_to_bag(make_map(), source, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()
