"""Recordings that are played, recorded again and listed; what is published of an estimate."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.interop.live.bag_recording import RecordingOptions, record_bag
from maplab_py.interop.live.connection import list_topics, open_transport
from maplab_py.interop.live.options import LiveOptions, NetworkOptions
from maplab_py.interop.live.playing import PlayingOptions, play_recording
from maplab_py.interop.live.publishing import Estimate, PosePublisher, ros_covariances
from maplab_py.interop.live.transport import wait_for_topics
from maplab_py.interop.recordings import bag_files, stream
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.reader_choice import open_recording
from tests.interop.live import support
from tests.interop.recordings import written

PORT = 20_000 + os.getpid() % 20_000


@pytest.fixture(scope="module")
def content() -> written.Content:
    return support.gravity(written.make_content())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, content: written.Content) -> Path:
    return written.write_folder(content, tmp_path_factory.mktemp("played") / "room")


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("calibration")
    support.small_device(place)
    return place / "sensors.yaml"


def play(folder: Path, kind: str, network: NetworkOptions, **options: float) -> threading.Thread:
    """Play in the background."""
    chosen = PlayingOptions(rate=options.get("rate", 4.0))
    recording = open_recording(folder)
    thread = threading.Thread(target=play_recording, args=(recording, kind, network, chosen))
    thread.start()
    return thread


@pytest.mark.parametrize(("kind", "name"), [("ros1", "again.bag"), ("foxglove", "again")])
def test_a_played_recording_is_recorded_stamp_by_stamp(
    folder: Path, content: written.Content, calibration: Path, tmp_path: Path, kind: str, name: str
) -> None:
    """ROS 2 takes two programs, see the last test."""
    if kind == "foxglove":
        pytest.importorskip("websockets")
    with support.small_master() as master:
        url = f"ws://127.0.0.1:{PORT + 1}"
        network = NetworkOptions(ros_master_uri=master.uri, foxglove_url=url)
        player = play(folder, kind, network)
        names = RecordingOptions("/imu0,/cam0/image_raw,cam1/image_raw")
        report = record_bag(kind, tmp_path / name, network, names, silence_s=1.5)
        player.join()
    assert [t.messages for t in report.topics] == [len(content.imu_ns), 8, 8]
    again = open_recording(tmp_path / name, SourceOptions(sensor_calibration_file=calibration))
    written.assert_content(list(stream.EventStream(again)), content)


def test_a_bag_of_ros_2_is_a_folder(tmp_path: Path) -> None:
    with support.small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with pytest.raises(UserError, match=r"go to a file \.bag: name it so"):
            record_bag("ros1", tmp_path / "bag", network, RecordingOptions(), silence_s=1.0)


def test_a_client_of_foxglove_reads_what_the_server_plays(
    folder: Path, content: written.Content, calibration: Path, tmp_path: Path
) -> None:
    pytest.importorskip("websockets")
    network = NetworkOptions(foxglove_url=f"ws://127.0.0.1:{PORT}")
    player = play(folder, "foxglove", network)
    with open_transport("foxglove", network) as client:
        names = ["/cam0/image_raw", "/cam1/image_raw", "/imu0"]
        wait_for_topics(client, names, 10.0)
        assert sorted(client.topics()) == names
        device = open_recording(folder).device
        source = SourceOptions(imu_topic="/imu0", camera_topics="/cam0/image_raw,/cam1/image_raw")
        recording = support.live(client, device, source, LiveOptions(silence_s=1.5), wait_s=5.0)
        items = list(recording.items())
    player.join()
    images = [item for item in items if hasattr(item, "camera")]
    assert [image.stamp_ns for image in images[::2]] == content.stamps_ns[0].tolist()
    times = np.concatenate([item.times_ns for item in items if hasattr(item, "times_ns")])
    assert np.array_equal(times, content.imu_ns)


def test_no_server_of_foxglove_is_said_with_the_remedy() -> None:
    pytest.importorskip("websockets")
    with (
        pytest.raises(UserError, match=r"does not answer .*: start foxglove_bridge"),
        open_transport(
            "foxglove", NetworkOptions(foxglove_url="ws://127.0.0.1:1", live_wait_s=0.2)
        ),
    ):
        pass


def test_topics_are_listed_with_their_rates() -> None:
    with support.small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as robot:
            publish = robot.advertise("/imu0", support.IMU)
            is_over = threading.Event()

            def send() -> None:
                stamp_ns = 0
                while not is_over.wait(0.02):
                    stamp_ns += 1
                    publish(support.imu_message(stamp_ns, is_ros_2=False))

            thread = threading.Thread(target=send)
            thread.start()
            report = list_topics("ros1", network, 1.0)
            is_over.set()
            thread.join()
    (topic,) = report.topics
    assert (topic.topic, topic.type, topic.publishers) == ("/imu0", support.IMU, 1)
    assert topic.rate_hz is not None
    assert 5.0 < topic.rate_hz < 55.0
    assert report.failure == ""


def test_nothing_to_list_is_a_failure_with_advice() -> None:
    with support.small_master() as master:
        report = list_topics("ros1", NetworkOptions(ros_master_uri=master.uri), 0.2)
    assert "nobody publishes anything" in report.failure
    assert "ROS_DOMAIN_ID" in report.advice


def test_wrong_transports_are_refused(folder: Path) -> None:
    with pytest.raises(UserError, match="transport ros3: wants one of ros2, ros1, foxglove"):
        list_topics("ros3", NetworkOptions(), 1.0)
    with pytest.raises(UserError, match="--play_rate=-1"):
        play_recording(open_recording(folder), "ros1", NetworkOptions(), PlayingOptions(rate=-1.0))


def test_ros_2_is_played_and_recorded_by_two_programs(
    folder: Path, content: written.Content, calibration: Path, tmp_path: Path
) -> None:
    pytest.importorskip("cyclonedds")
    domain = f"--ros_domain_id={10 + os.getpid() % 80}"
    program = [sys.executable, "-m", "maplab_py", "-c"]
    source = f"--sensor_calibration_file={calibration}"
    player = subprocess.Popen(
        [*program, f"play_recording {folder} ros2 {domain} {source} --play_rate=2 --live_wait_s=60"]
    )
    topics = "--record_topics=/imu0,/cam0/image_raw,/cam1/image_raw"
    bag = tmp_path / "again"
    command = f"record_bag ros2 {bag} {domain} {topics} --live_wait_s=60 --live_silence_s=3"
    done = subprocess.run(
        [*program, command], check=False, capture_output=True, text=True, timeout=150
    )
    assert player.wait(60) == 0
    assert done.returncode == 0, done.stderr
    again = open_recording(bag, SourceOptions(sensor_calibration_file=calibration))
    written.assert_content(list(stream.EventStream(again)), content)


def random_estimate(seed: int, *, is_localised: bool = True) -> Estimate:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(15, 15))
    q = so3.exp(rng.normal(size=(2, 3)))
    poses = np.concatenate([q, rng.normal(size=(2, 3))], axis=1)
    return Estimate(
        5_000_000_001,
        poses[0],
        rng.normal(size=3),
        rng.normal(size=3),
        factor @ factor.T,
        poses[1] if is_localised else None,
    )


@pytest.mark.parametrize("is_ros_2", [True, False])
def test_the_estimate_is_in_the_messages(is_ros_2: bool) -> None:
    transport, estimate = support.FakeTransport(is_ros_2=is_ros_2), random_estimate(1)
    publisher = PosePublisher(transport, LiveOptions(publish_landmarks=True))
    publisher.publish(estimate)
    publisher.publish_landmarks(5, np.ones((4, 3)))
    store = bag_files.message_types(is_ros_2=is_ros_2)
    decode = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    odometry = decode(transport.published["/maplab/odometry"][0], "nav_msgs/msg/Odometry")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "imu")
    assert (odometry.header.stamp.sec, odometry.header.stamp.nanosec) == (5, 1)
    pose_covariance, twist_covariance = ros_covariances(estimate)
    assert np.array_equal(odometry.pose.covariance, pose_covariance.reshape(36))
    assert np.array_equal(odometry.twist.covariance, twist_covariance.reshape(36))
    v_I = so3.rotate(so3.inverse(estimate.T_M_I[:4]), estimate.v_M_I)
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    assert np.allclose([linear.x, linear.y, linear.z], v_I)
    assert np.array_equal([angular.x, angular.y, angular.z], estimate.w_I)
    pose = decode(transport.published["/maplab/pose_in_map"][0], "geometry_msgs/msg/PoseStamped")
    assert pose.header.frame_id == "map"
    position = pose.pose.position
    T_G_I = se3.compose(estimate.T_G_M, estimate.T_M_I)
    assert np.allclose([position.x, position.y, position.z], T_G_I[4:])
    transforms = decode(transport.published["/tf"][0], "tf2_msgs/msg/TFMessage").transforms
    frames = [(t.header.frame_id, t.child_frame_id) for t in transforms]
    assert frames == [("map", "odom"), ("odom", "imu")]
    cloud = decode(transport.published["/maplab/landmarks"][0], "sensor_msgs/msg/PointCloud2")
    assert cloud.width == 4


def test_without_a_map_there_is_no_pose_in_it() -> None:
    transport = support.FakeTransport()
    PosePublisher(transport, LiveOptions()).publish(random_estimate(2, is_localised=False))
    assert transport.published["/maplab/pose_in_map"] == []
    message = bag_files.message_types(is_ros_2=True).deserialize_cdr(
        transport.published["/tf"][0], "tf2_msgs/msg/TFMessage"
    )
    assert [t.child_frame_id for t in message.transforms] == ["imu"]


def numeric_jacobian(estimate: Estimate, tangent_of: object) -> F64:
    step = 1e-6
    columns = []
    for row in range(15):
        d = np.zeros(15)
        d[row] = step
        columns.append((tangent_of(d) - tangent_of(-d)) / (2 * step))  # type: ignore[operator]
    return np.array(columns).T


def test_covariances_are_those_that_ros_defines() -> None:
    estimate = random_estimate(3)
    q, p = estimate.T_M_I[:4], estimate.T_M_I[4:]

    def pose(d: F64) -> F64:
        turned = so3.multiply(q, so3.exp(d[3:6]))
        return np.concatenate([p + d[:3], so3.log(so3.multiply(turned, so3.inverse(q)))])

    def twist(d: F64) -> F64:
        turned = so3.multiply(q, so3.exp(d[3:6]))
        v_I = so3.rotate(so3.inverse(turned), estimate.v_M_I + d[6:9])
        return np.concatenate([v_I, estimate.w_I - d[9:12]])

    for covariance, tangent in zip(ros_covariances(estimate), (pose, twist), strict=True):
        J = numeric_jacobian(estimate, tangent)
        assert np.allclose(covariance, J @ estimate.covariance @ J.T, rtol=1e-5, atol=1e-6)


def test_an_unknown_covariance_is_zero() -> None:
    estimate = Estimate(1, se3.identity(), np.zeros(3), np.zeros(3))
    assert not np.any(ros_covariances(estimate))
