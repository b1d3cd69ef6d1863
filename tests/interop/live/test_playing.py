"""Recordings that are played, recorded again and listed: stamp by stamp what they were."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.interop.live.bag_recording import RecordingOptions, record_bag
from maplab_py.interop.live.listing import list_topics
from maplab_py.interop.live.opening import open_transport
from maplab_py.interop.live.options import LiveOptions, NetworkOptions
from maplab_py.interop.live.playing import PlayingOptions, play_recording
from maplab_py.interop.live.transport import wait_for_topics
from maplab_py.interop.recordings.opening import open_recording
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.stream import EventStream
from tests.interop.live.support import IMU, gravity, imu_message, live, small_device, small_master
from tests.interop.recordings.written import (
    Content,
    assert_content,
    make_content,
    write_folder,
)

PORT = 20_000 + os.getpid() % 20_000


@pytest.fixture(scope="module")
def content() -> Content:
    return gravity(make_content())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, content: Content) -> Path:
    return write_folder(content, tmp_path_factory.mktemp("played") / "room")


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("calibration")
    small_device(place)
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
    folder: Path, content: Content, calibration: Path, tmp_path: Path, kind: str, name: str
) -> None:
    """ROS 2 takes two programs, see the last test."""
    if kind == "foxglove":
        pytest.importorskip("websockets")
    with small_master() as master:
        url = f"ws://127.0.0.1:{PORT + 1}"
        network = NetworkOptions(ros_master_uri=master.uri, foxglove_url=url)
        player = play(folder, kind, network)
        names = RecordingOptions("/imu0,/cam0/image_raw,cam1/image_raw")
        report = record_bag(kind, tmp_path / name, network, names, silence_s=1.5)
        player.join()
    assert [t.messages for t in report.topics] == [len(content.imu_ns), 8, 8]
    again = open_recording(tmp_path / name, SourceOptions(sensor_calibration_file=calibration))
    assert_content(list(EventStream(again)), content)


def test_a_bag_of_ros_2_is_a_folder(tmp_path: Path) -> None:
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with pytest.raises(UserError, match=r"go to a file \.bag: name it so"):
            record_bag("ros1", tmp_path / "bag", network, RecordingOptions(), silence_s=1.0)


def test_a_client_of_foxglove_reads_what_the_server_plays(
    folder: Path, content: Content, calibration: Path, tmp_path: Path
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
        recording = live(client, device, source, LiveOptions(silence_s=1.5), wait_s=5.0)
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
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as robot:
            publish = robot.advertise("/imu0", IMU)
            is_over = threading.Event()

            def send() -> None:
                stamp_ns = 0
                while not is_over.wait(0.02):
                    stamp_ns += 1
                    publish(imu_message(stamp_ns, is_ros_2=False))

            thread = threading.Thread(target=send)
            thread.start()
            report = list_topics("ros1", network, 1.0)
            is_over.set()
            thread.join()
    (topic,) = report.topics
    assert (topic.topic, topic.type, topic.publishers) == ("/imu0", IMU, 1)
    assert topic.rate_hz is not None
    assert 5.0 < topic.rate_hz < 55.0
    assert report.failure == ""


def test_nothing_to_list_is_a_failure_with_advice() -> None:
    with small_master() as master:
        report = list_topics("ros1", NetworkOptions(ros_master_uri=master.uri), 0.2)
    assert "nobody publishes anything" in report.failure
    assert "ROS_DOMAIN_ID" in report.advice


def test_wrong_transports_are_refused(folder: Path) -> None:
    with pytest.raises(UserError, match="transport ros3: wants one of ros2, ros1, foxglove"):
        list_topics("ros3", NetworkOptions(), 1.0)
    with pytest.raises(UserError, match="--play_rate=-1"):
        play_recording(open_recording(folder), "ros1", NetworkOptions(), PlayingOptions(rate=-1.0))


def test_ros_2_is_played_and_recorded_by_two_programs(
    folder: Path, content: Content, calibration: Path, tmp_path: Path
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
    assert_content(list(EventStream(again)), content)
