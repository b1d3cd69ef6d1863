"""export_bag: what a mission has, read back with rosbags and with rovioli's reader."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.errors import Cancelled, FlagError, MapError, UserError
from maplab_py.interop.bags.exporting import export_bag
from maplab_py.interop.bags.listing import bag_info
from maplab_py.interop.bags.options import BagExportOptions
from maplab_py.interop.bags.sensor_messages import cloud_of
from maplab_py.interop.recordings.bag_writing import BagFormat
from maplab_py.interop.recordings.map_replay import mission_sample_rows
from maplab_py.interop.recordings.opening import open_recording
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.stream import EventStream
from maplab_py.progress import SilentProgress
from maplab_py.sensors import Projection
from maplab_py.sensors.sensors_yaml import write_sensors
from tests.interop.bags.small_bags import (
    FORMATS,
    OFFSET_NS,
    map_with_resources,
    messages_of,
    named,
    with_camera,
)
from tests.interop.recordings.written import frame_sets, samples
from tests.interop.small_map import VERTICES, make_map

pytest.importorskip("rosbags")


@pytest.mark.parametrize("kind", FORMATS)
def test_rovioli_reads_what_the_map_has(tmp_path: Path, kind: BagFormat) -> None:
    vi_map, images, _ = map_with_resources()
    path = named(tmp_path, kind)
    report = export_bag(vi_map, tmp_path, 0, path, BagExportOptions(format=kind.value))
    assert report.notes == ()
    (tmp_path / "sensors.yaml").write_text(write_sensors(vi_map.sensors))
    source = SourceOptions(sensor_calibration_file=tmp_path / "sensors.yaml", imu_topic="/imu0")
    events = list(EventStream(open_recording(path, source)))
    times_ns, accel_gyro = samples(events)
    rows = mission_sample_rows(vi_map, 0)
    np.testing.assert_array_equal(times_ns, vi_map.imu_samples.timestamp_ns[rows])
    np.testing.assert_array_equal(accel_gyro, vi_map.imu_samples.accel_gyro[rows])
    sets = frame_sets(events)
    assert [s.time_ns for s in sets] == vi_map.vertices.timestamp_ns[:VERTICES].tolist()
    for frame_set, image in zip(sets, images, strict=True):
        assert frame_set.images[0].stamp_ns == frame_set.time_ns - OFFSET_NS
        np.testing.assert_array_equal(frame_set.images[0].decode(), image)


@pytest.mark.parametrize("kind", FORMATS)
def test_all_topics_read_back(tmp_path: Path, kind: BagFormat) -> None:
    vi_map, _, clouds = map_with_resources()
    path = named(tmp_path, kind)
    export_bag(vi_map, tmp_path, 0, path, BagExportOptions(format=kind.value))
    topics = messages_of(path)
    assert {topic: len(messages) for topic, messages in topics.items()} == {
        "/pose": VERTICES,
        "/path": 1,
        "/odometry": VERTICES,
        "/tf": VERTICES,
        "/imu0": len(mission_sample_rows(vi_map, 0)),
        "/left/image_raw": VERTICES,
        "/cam0/camera_info": VERTICES,
        "/cam0/depth": 3,
        "/points0": 3,
    }
    pose = topics["/pose"][2][1].pose
    assert [pose.position.x, pose.orientation.z] == vi_map.T_G_I[2, [4, 2]].tolist()
    time_ns, path_message = topics["/path"][0]
    assert time_ns == vi_map.vertices.timestamp_ns[VERTICES - 1]
    positions = [[p.x, p.y, p.z] for p in (entry.pose.position for entry in path_message.poses)]
    np.testing.assert_array_equal(positions, vi_map.T_G_I[:VERTICES, 4:])
    tree = topics["/tf"][0][1].transforms
    assert [t.child_frame_id for t in tree] == ["mission", "imu", "cam0"]
    info = topics["/cam0/camera_info"][0][1]
    K = info.k if kind.is_ros_2 else info.K
    assert K.tolist() == [250.0, 0.0, 320.0, 0.0, 251.0, 240.0, 0.0, 0.0, 1.0]
    depth = topics["/cam0/depth"][1][1]
    assert (depth.encoding, depth.step) == ("16UC1", 1280)
    assert depth.data.view("<u2")[-1] == 10_000  # mm
    for (time_ns, message), cloud in zip(topics["/points0"], clouds, strict=True):
        assert time_ns % 10 == (vi_map.vertices.timestamp_ns[0] + 7) % 10
        read = cloud_of(message, "cloud")
        for name in ("p", "colours", "intensity"):
            expected = getattr(cloud, name)
            if expected is None:
                assert getattr(read, name) is None
            else:
                np.testing.assert_array_equal(getattr(read, name), expected)


def test_only_what_is_asked_for(tmp_path: Path) -> None:
    options = BagExportOptions(content="imu, poses", format="sqlite3", world_frame="office")
    report = export_bag(make_map(), tmp_path, 1, tmp_path / "walk", options)
    info = bag_info(tmp_path / "walk")
    assert [(t.topic, t.messages) for t in info.topics] == [
        (t.topic, t.messages) for t in report.topics
    ]
    assert [t.topic for t in info.topics] == ["/imu0", "/pose"]
    assert messages_of(tmp_path / "walk")["/pose"][0][1].header.frame_id == "office"
    with pytest.raises(FlagError, match="bag_content=imu,pose: wants some of poses"):
        export_bag(make_map(), tmp_path, 1, tmp_path / "b", BagExportOptions(content="imu,pose"))
    options = BagExportOptions(content="images,clouds")
    with pytest.raises(UserError, match="has none of images, clouds"):
        export_bag(make_map(), tmp_path, 1, tmp_path / "b", options)
    assert not (tmp_path / "b").exists()


def test_a_model_without_camera_info_is_told(tmp_path: Path) -> None:
    vi_map = with_camera(
        map_with_resources()[0],
        projection=Projection.UNIFIED,
        intrinsics=np.array([0.9, 250.0, 251.0, 320.0, 240.0]),
    )
    report = export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    assert report.notes == ("camera 0 has a model that CameraInfo does not have",)
    assert "/cam0/camera_info" not in [t.topic for t in report.topics]


def test_two_sensors_of_the_same_topic_are_refused(tmp_path: Path) -> None:
    vi_map = with_camera(map_with_resources()[0], topic="imu0")
    with pytest.raises(UserError, match="two sensors of the mission have the topic /imu0"):
        export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")


def test_a_missing_image_leaves_no_bag(tmp_path: Path) -> None:
    vi_map, _, _ = map_with_resources()
    folder = Path(vi_map.metadata.external_resource_folders[0])
    sorted((folder / "raw_images").iterdir())[0].unlink()
    with pytest.raises(MapError, match="raw_images"):
        export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", FORMATS)
def test_cancelling_leaves_no_bag(tmp_path: Path, kind: BagFormat) -> None:
    class Impatient(SilentProgress):
        def step(self, done: float, total: float, what: str = "") -> None:
            if done > 0:
                raise Cancelled("cancelled")

    vi_map, _, _ = map_with_resources()
    with obeying(CancelToken()), pytest.raises(Cancelled):
        export_bag(
            vi_map,
            tmp_path,
            0,
            named(tmp_path, kind),
            BagExportOptions(format=kind.value),
            progress=Impatient(),
        )
    assert list(tmp_path.iterdir()) == []


def test_bag_info_lists_topics_and_finds_damage(tmp_path: Path) -> None:
    vi_map, _, _ = map_with_resources()
    export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    info = bag_info(tmp_path / "walk.bag")
    assert (info.format, info.messages) == ("ros1", sum(t.messages for t in info.topics))
    assert info.start_ns == vi_map.vertices.timestamp_ns[0]
    imu = next(t for t in info.topics if t.topic == "/imu0")
    assert (imu.type, imu.start_s) == ("sensor_msgs/msg/Imu", 0.0)
    assert imu.rate_hz == pytest.approx(100.0)
    assert imu.duration_s == pytest.approx(2.5)
    cut = tmp_path / "cut.bag"
    cut.write_bytes((tmp_path / "walk.bag").read_bytes()[:-100])
    with pytest.raises(MapError, match=r"cut\.bag: the bag cannot be read"):
        bag_info(cut)
    with pytest.raises(UserError, match=r"none\.bag does not exist"):
        bag_info(tmp_path / "none.bag")
