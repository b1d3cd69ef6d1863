"""Bags of a map: missions, poses and the whole scene, read back with rosbags and by rovioli."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.cancellation import CancelToken, obeying
from maplab_py.errors import Cancelled, FlagError, MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.bags import listing, sensor_messages
from maplab_py.interop.bags.exporting import export_bag, export_mcap
from maplab_py.interop.bags.options import BagExportOptions, PoseToBagOptions
from maplab_py.interop.bags.poses import add_poses_to_bag, pose_times
from maplab_py.interop.recordings import bag_writing, map_replay, reader_choice, stream
from maplab_py.interop.recordings.bag_files import opened_bag
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.vertex_states import poses_at
from maplab_py.progress import SilentProgress
from maplab_py.sensors import Projection, sensors_yaml
from maplab_py.vimap import LandmarkQuality, LoopClosureEdges, VIMap
from tests.interop.bags import small_bags
from tests.interop.recordings.written import frame_sets, make_content, samples, write_bag
from tests.interop.small_map import PERIOD_NS, VERTICES, make_map

pytest.importorskip("rosbags")


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_rovioli_reads_what_the_map_has(tmp_path: Path, kind: bag_writing.BagFormat) -> None:
    vi_map, images, _ = small_bags.map_with_resources()
    path = small_bags.named(tmp_path, kind)
    report = export_bag(vi_map, tmp_path, 0, path, BagExportOptions(format=kind.value))
    assert report.notes == ()
    (tmp_path / "sensors.yaml").write_text(sensors_yaml.write_sensors(vi_map.sensors))
    source = SourceOptions(sensor_calibration_file=tmp_path / "sensors.yaml", imu_topic="/imu0")
    events = list(stream.EventStream(reader_choice.open_recording(path, source)))
    times_ns, accel_gyro = samples(events)
    rows = map_replay.mission_sample_rows(vi_map, 0)
    np.testing.assert_array_equal(times_ns, vi_map.imu_samples.timestamp_ns[rows])
    np.testing.assert_array_equal(accel_gyro, vi_map.imu_samples.accel_gyro[rows])
    sets = frame_sets(events)
    assert [s.time_ns for s in sets] == vi_map.vertices.timestamp_ns[:VERTICES].tolist()
    for frame_set, image in zip(sets, images, strict=True):
        assert frame_set.images[0].stamp_ns == frame_set.time_ns - small_bags.OFFSET_NS
        np.testing.assert_array_equal(frame_set.images[0].decode(), image)


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_all_topics_read_back(tmp_path: Path, kind: bag_writing.BagFormat) -> None:
    vi_map, _, clouds = small_bags.map_with_resources()
    path = small_bags.named(tmp_path, kind)
    export_bag(vi_map, tmp_path, 0, path, BagExportOptions(format=kind.value))
    topics = small_bags.messages_of(path)
    assert {topic: len(messages) for topic, messages in topics.items()} == {
        "/pose": VERTICES,
        "/path": 1,
        "/odometry": VERTICES,
        "/tf": VERTICES,
        "/imu0": len(map_replay.mission_sample_rows(vi_map, 0)),
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
        read = sensor_messages.cloud_of(message, "cloud")
        for name in ("p", "colours", "intensity"):
            expected = getattr(cloud, name)
            if expected is None:
                assert getattr(read, name) is None
            else:
                np.testing.assert_array_equal(getattr(read, name), expected)


def test_only_what_is_asked_for(tmp_path: Path) -> None:
    options = BagExportOptions(content="imu, poses", format="sqlite3", world_frame="office")
    report = export_bag(make_map(), tmp_path, 1, tmp_path / "walk", options)
    info = listing.bag_info(tmp_path / "walk")
    assert [(t.topic, t.messages) for t in info.topics] == [
        (t.topic, t.messages) for t in report.topics
    ]
    assert [t.topic for t in info.topics] == ["/imu0", "/pose"]
    assert small_bags.messages_of(tmp_path / "walk")["/pose"][0][1].header.frame_id == "office"
    with pytest.raises(FlagError, match="bag_content=imu,pose: wants some of poses"):
        export_bag(make_map(), tmp_path, 1, tmp_path / "b", BagExportOptions(content="imu,pose"))
    options = BagExportOptions(content="images,clouds")
    with pytest.raises(UserError, match="has none of images, clouds"):
        export_bag(make_map(), tmp_path, 1, tmp_path / "b", options)
    assert not (tmp_path / "b").exists()


def test_a_model_without_camera_info_is_told(tmp_path: Path) -> None:
    vi_map = small_bags.with_camera(
        small_bags.map_with_resources()[0],
        projection=Projection.UNIFIED,
        intrinsics=np.array([0.9, 250.0, 251.0, 320.0, 240.0]),
    )
    report = export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    assert report.notes == ("camera 0 has a model that CameraInfo does not have",)
    assert "/cam0/camera_info" not in [t.topic for t in report.topics]


def test_two_sensors_of_the_same_topic_are_refused(tmp_path: Path) -> None:
    vi_map = small_bags.with_camera(small_bags.map_with_resources()[0], topic="imu0")
    with pytest.raises(UserError, match="two sensors of the mission have the topic /imu0"):
        export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")


def test_a_missing_image_leaves_no_bag(tmp_path: Path) -> None:
    vi_map, _, _ = small_bags.map_with_resources()
    folder = Path(vi_map.metadata.external_resource_folders[0])
    sorted((folder / "raw_images").iterdir())[0].unlink()
    with pytest.raises(MapError, match="raw_images"):
        export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_cancelling_leaves_no_bag(tmp_path: Path, kind: bag_writing.BagFormat) -> None:
    class Impatient(SilentProgress):
        def step(self, done: float, total: float, what: str = "") -> None:
            if done > 0:
                raise Cancelled("cancelled")

    vi_map, _, _ = small_bags.map_with_resources()
    with obeying(CancelToken()), pytest.raises(Cancelled):
        export_bag(
            vi_map,
            tmp_path,
            0,
            small_bags.named(tmp_path, kind),
            BagExportOptions(format=kind.value),
            progress=Impatient(),
        )
    assert list(tmp_path.iterdir()) == []


def test_bag_info_lists_topics_and_finds_damage(tmp_path: Path) -> None:
    vi_map, _, _ = small_bags.map_with_resources()
    export_bag(vi_map, tmp_path, 0, tmp_path / "walk.bag")
    info = listing.bag_info(tmp_path / "walk.bag")
    assert (info.format, info.messages) == ("ros1", sum(t.messages for t in info.topics))
    assert info.start_ns == vi_map.vertices.timestamp_ns[0]
    imu = next(t for t in info.topics if t.topic == "/imu0")
    assert (imu.type, imu.start_s) == ("sensor_msgs/msg/Imu", 0.0)
    assert imu.rate_hz == pytest.approx(100.0)
    assert imu.duration_s == pytest.approx(2.5)
    cut = tmp_path / "cut.bag"
    cut.write_bytes((tmp_path / "walk.bag").read_bytes()[:-100])
    with pytest.raises(MapError, match=r"cut\.bag: the bag cannot be read"):
        listing.bag_info(cut)
    with pytest.raises(UserError, match=r"none\.bag does not exist"):
        listing.bag_info(tmp_path / "none.bag")


pytest.importorskip("rosbags")

FIRST = np.array([0])
VERTEX_RATE = PoseToBagOptions(interpolate_to_frequency_hz=1e-3)


def recorded(folder: Path, kind: bag_writing.BagFormat) -> Path:
    version = 2 if kind.is_ros_2 else 1
    return write_bag(
        make_content(), small_bags.named(folder, kind, "in"), version=version, storage=kind.value
    )


def raw(path: Path) -> list[tuple[str, int, bytes]]:
    with opened_bag(path) as reader:
        return [(c.topic, time_ns, data) for c, time_ns, data in reader.messages()]


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_messages_stay_and_poses_come(tmp_path: Path, kind: bag_writing.BagFormat) -> None:
    vi_map, source = make_map(), recorded(tmp_path, kind)
    target = small_bags.named(tmp_path, kind)
    report = add_poses_to_bag(vi_map, source, target, VERTEX_RATE, missions=FIRST)
    before = raw(source)
    after = raw(target)
    assert [entry for entry in after if not entry[0].startswith(("/T_", "/tf"))] == before
    assert [time for _, time, _ in after] == sorted(time for _, time, _ in after)
    assert report.copied_messages == len(before)
    assert report.messages == len(after) == len(before) + 4 * VERTICES
    topics = small_bags.messages_of(target)
    stamps = vi_map.vertices.timestamp_ns[:VERTICES].tolist()
    for name, T, frames in (
        ("/T_M_I", vi_map.vertices.T_M_I[:VERTICES], ("mission", "imu")),
        ("/T_G_I", vi_map.T_G_I[:VERTICES], ("map", "imu")),
        ("/T_G_M", np.tile(vi_map.T_G_M[0], (VERTICES, 1)), ("map", "mission")),
    ):
        assert [time for time, _ in topics[name]] == stamps
        poses = [small_bags.pose_of(message.transform) for _, message in topics[name]]
        np.testing.assert_array_equal(poses, T)
        heads = {(m.header.frame_id, m.child_frame_id) for _, m in topics[name]}
        assert heads == {frames}
    tree = [message.transforms for _, message in topics["/tf"]]
    assert [len(transforms) for transforms in tree] == [2] * VERTICES
    assert [t.child_frame_id for t in tree[0]] == ["mission", "imu"]
    np.testing.assert_array_equal(
        [small_bags.pose_of(transforms[1].transform) for transforms in tree],
        vi_map.vertices.T_M_I[:VERTICES],
    )


def test_several_missions_are_numbered_by_time(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, bag_writing.BagFormat.ROS1)
    options = PoseToBagOptions(base_frame="body", odom_frame="odom", world_frame="world")
    add_poses_to_bag(vi_map, source, tmp_path / "out.bag", options)
    topics = small_bags.messages_of(tmp_path / "out.bag")
    for number in (0, 1):
        message = topics[f"/T_M_I_{number}"][0][1]
        assert (message.header.frame_id, message.child_frame_id) == (
            f"odom_{number}",
            f"body_{number}",
        )
        assert topics[f"/T_G_I_{number}"][0][1].header.frame_id == "world"
        assert topics[f"/T_M_I_{number}"][0][0] == vi_map.vertices.timestamp_ns[number * VERTICES]


def test_poses_between_vertices(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, bag_writing.BagFormat.MCAP)
    options = PoseToBagOptions(add_tf=False, interpolate_to_frequency_hz=8.0)
    add_poses_to_bag(vi_map, source, tmp_path / "out", options, missions=FIRST)
    topics = small_bags.messages_of(tmp_path / "out")
    assert "/tf" not in topics
    times_ns = np.array([time for time, _ in topics["/T_M_I"]])
    assert len(times_ns) == 4 * (VERTICES - 1) + 1
    assert set(np.diff(times_ns)) == {PERIOD_NS // 4}
    T_M_I = np.array([small_bags.pose_of(message.transform) for _, message in topics["/T_M_I"]])
    np.testing.assert_array_equal(T_M_I, poses_at(vi_map, 0, times_ns))
    t = (times_ns - times_ns[0]) * 1e-9
    np.testing.assert_allclose(T_M_I[:, 6], 0.1 * t**2, atol=1e-12)  # cubic, not linear
    T_G_I = np.array([small_bags.pose_of(message.transform) for _, message in topics["/T_G_I"]])
    np.testing.assert_array_equal(T_G_I, se3.compose(vi_map.T_G_M[0], T_M_I))


@given(
    gaps=st.lists(st.integers(1, 300), min_size=1, max_size=8),
    period=st.integers(1, 100),
)
def test_pose_times(gaps: list[int], period: int) -> None:
    stamps = np.cumsum([5, *gaps])
    expected = {
        int(time) for a, b in pairwise(stamps.tolist()) for time in [*range(a, b, period), b]
    }
    assert pose_times(stamps, period).tolist() == sorted(expected)


@pytest.mark.parametrize("kind", small_bags.FORMATS)
def test_a_bag_with_poses_gets_further_ones_or_loses_them(
    tmp_path: Path, kind: bag_writing.BagFormat
) -> None:
    vi_map, source = make_map(), recorded(tmp_path, kind)
    once, twice, dropped = (
        small_bags.named(tmp_path, kind, name) for name in ("once", "twice", "dropped")
    )
    add_poses_to_bag(vi_map, source, once, VERTEX_RATE, missions=FIRST)
    add_poses_to_bag(vi_map, once, twice, VERTEX_RATE, missions=FIRST)
    assert len(small_bags.messages_of(twice)["/tf"]) == 2 * VERTICES
    assert len(small_bags.messages_of(twice)["/T_G_I"]) == 2 * VERTICES
    options = PoseToBagOptions(add_tf=False, add_transform_stamped=False, drop_tf=True)
    add_poses_to_bag(vi_map, once, dropped, options, missions=FIRST)
    assert set(small_bags.messages_of(once)) - set(small_bags.messages_of(dropped)) == {"/tf"}


@pytest.mark.parametrize("kind", [bag_writing.BagFormat.SQLITE3, bag_writing.BagFormat.MCAP])
def test_a_single_file_of_a_ros_2_bag(tmp_path: Path, kind: bag_writing.BagFormat) -> None:
    (file, _) = bag_writing.bag_files(recorded(tmp_path, kind), kind)
    report = add_poses_to_bag(make_map(), file, tmp_path / "out", VERTEX_RATE, missions=FIRST)
    assert report.format == kind.value
    assert len(small_bags.messages_of(tmp_path / "out")["/T_G_I"]) == VERTICES


def test_wrong_bags_are_refused(tmp_path: Path) -> None:
    vi_map, source = make_map(), recorded(tmp_path, bag_writing.BagFormat.ROS1)
    target = tmp_path / "out.bag"

    def refused(problem: str, kind: type[Exception] = UserError, **paths: Path) -> None:
        with pytest.raises(kind, match=problem) as error:
            add_poses_to_bag(vi_map, **({"source": source, "target": target} | paths))
        assert "\n" not in str(error.value)
        assert not target.exists()

    refused("input_bag=.*no.bag does not exist", source=tmp_path / "no.bag")
    (tmp_path / "text.txt").write_text("hello")
    refused("text.txt is no bag", source=tmp_path / "text.txt")
    refused("is the input: name another bag", target=source)
    refused("name it so, or give another", target=tmp_path / "folder")
    cut = tmp_path / "cut.bag"
    cut.write_bytes(source.read_bytes()[:-2000])
    refused("cut.bag: the bag cannot be read", MapError, source=cut)
    unindexed = tmp_path / "unindexed.bag"
    data = source.read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    unindexed.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    refused("unindexed.bag: the bag cannot be read .*reindex", MapError, source=unindexed)
    wrong = tmp_path / "wrong.bag"
    times_ns = np.array([10, 20])
    rows = sensor_messages.MessageMaker(is_ros_2=False).poses(times_ns, se3.identity(2), "map")
    kind = "geometry_msgs/msg/PoseStamped"
    bag_writing.write_bag(
        wrong,
        bag_writing.BagFormat.ROS1,
        bag_writing.messages_of_topic(times_ns, "/tf", kind, rows),
    )
    refused("/tf has messages of type .*drop_tf", MapError, source=wrong)
    with pytest.raises(UserError, match="no vertices"):
        add_poses_to_bag(VIMap(), source, target)
    target.write_bytes(b"kept")
    with pytest.raises(UserError, match="exists already: give --overwrite"):
        add_poses_to_bag(vi_map, source, target)
    assert target.read_bytes() == b"kept"
    add_poses_to_bag(vi_map, source, target, overwrite=True)
    assert "/T_G_I_1" in small_bags.messages_of(target)


pytest.importorskip("rosbags")


def test_poses_landmarks_closures_and_images_read_back(tmp_path: Path) -> None:
    vi_map, images, _ = small_bags.map_with_resources()
    landmarks = vi_map.landmarks
    quality = np.full(len(landmarks), LandmarkQuality.GOOD, dtype=np.int8)
    closure = LoopClosureEdges.filled(1, from_vertex=[0], to_vertex=[2])
    vi_map = vi_map.replace(
        landmarks=landmarks.replace(quality=quality), loop_closure_edges=closure
    )
    report = export_mcap(vi_map, tmp_path, tmp_path / "scene")
    assert (tmp_path / "scene" / "scene.mcap").is_file()
    read = small_bags.messages_of(tmp_path / "scene")
    assert {topic.topic: topic.messages for topic in report.topics} == {
        topic: len(messages) for topic, messages in read.items()
    }
    by_kind = {topic.rsplit("/", 1)[1]: messages for topic, messages in read.items()}
    stamped = [m for topic, messages in read.items() if topic.endswith("/pose") for m in messages]
    poses = {time_ns: _position(message.pose) for time_ns, message in stamped}
    assert np.allclose(
        [poses[t] for t in vi_map.vertices.timestamp_ns.tolist()], vi_map.T_G_I[:, 4:]
    )
    if len(landmarks):
        cloud = sensor_messages.cloud_of(by_kind["landmarks"][0][1], "landmarks")
        assert np.allclose(cloud.p, vi_map.p_G, atol=1e-5)
    ends = by_kind["loop_closures"][0][1].points
    assert np.allclose([[p.x, p.y, p.z] for p in ends], vi_map.T_G_I[[0, 2], 4:])
    assert len(by_kind["image_raw"]) == len(images)


def _position(pose: object) -> list[float]:
    p = pose.position  # type: ignore[attr-defined]
    return [p.x, p.y, p.z]


def test_images_are_left_out_on_request(tmp_path: Path) -> None:
    vi_map = small_bags.map_with_resources()[0]
    report = export_mcap(vi_map, tmp_path, tmp_path / "scene", images=False)
    assert not any("image" in topic.topic for topic in report.topics)


def test_an_empty_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no vertices: there is nothing to show"):
        export_mcap(VIMap(), tmp_path, tmp_path / "scene")
