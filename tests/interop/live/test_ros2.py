"""Topics of ROS 2 between two programs; the counterparts of test_real_nodes are ROS itself."""

import os
import subprocess
import sys

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.interop.live import connection, receiving, ros2, transport
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.live.ros2 import dds_type_name, ros_type_name
from tests.interop.live.support import IMU, imu_message
from tests.support import own_process, waiting

pytest.importorskip("cyclonedds", reason="no cyclonedds for this machine")


def _domain() -> int:
    return 100 + os.getpid() % 100


def _round_trip() -> tuple[int, bool, list[str]]:
    with connection.open_transport("ros2", NetworkOptions(ros_domain_id=_domain())) as node:
        publish = node.advertise("/imu0", IMU)
        received: list[bytes] = []
        node.subscribe(transport.Topic("/imu0", IMU), received.append)
        assert waiting.wait_until(lambda: node.subscribers("/imu0"))
        sent = [imu_message(t, is_ros_2=True) for t in (1, 2, 3)]
        for message in sent:
            publish(message)
        assert waiting.wait_until(lambda: len(received) == 3)
        return len(received), received == sent, list(node.topics())


def test_messages_arrive_byte_by_byte() -> None:
    count, is_equal, others = own_process.in_own_process(_round_trip)
    assert (count, is_equal) == (3, True)
    assert others == []  # its own topics do not count


def test_names_of_types_are_those_of_ros() -> None:
    assert dds_type_name("sensor_msgs/msg/Image") == "sensor_msgs.msg.dds_.Image_"
    assert ros_type_name("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_type_name("example::Plain") == "example::Plain"


def test_it_listens_on_the_loopback_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    local = ros2._configuration(NetworkOptions())
    assert 'address="127.0.0.1" multicast="false"' in local
    assert "<AllowMulticast>false" in local
    monkeypatch.setenv("CYCLONEDDS_URI", "<CycloneDDS/>")
    beyond = ros2._configuration(NetworkOptions(live_interface="10.0.0.7"))
    assert 'address="10.0.0.7"' in beyond
    assert "<AllowMulticast>false" not in beyond
    assert beyond.endswith(",<CycloneDDS/>")


def test_small_socket_buffers_are_told_with_the_remedy(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object
) -> None:
    limit = tmp_path / "rmem_max"  # type: ignore[operator]
    monkeypatch.setattr(ros2, "_RECEIVE_LIMIT", limit)
    assert ros2._socket_problems() == []
    limit.write_text("212992\n")
    (problem,) = ros2._socket_problems()
    assert "sudo sysctl -w net.core.rmem_max=8388608" in problem


_SENDER = """
import sys, time
import numpy as np
from maplab_py.interop.bags.sensor_messages import MessageMaker
from maplab_py.interop.live import ros2
from maplab_py.interop.live.options import NetworkOptions
quality = ros2._quality
ros2._quality = lambda kind, is_reliable: quality(kind, is_reliable=False)
node = ros2.Ros2(NetworkOptions(ros_domain_id=int(sys.argv[1])))
publish = node.advertise("/image", "sensor_msgs/msg/Image")
maker, pixels = MessageMaker(is_ros_2=True), np.zeros((6, 7), np.uint8)
while not node.subscribers("/image"):
    time.sleep(0.05)
for index in range(160):
    if not 60 <= index < 70:  # lost on the way
        publish(maker.image(10**9 + index * 50_000_000, "cam0", pixels))
    time.sleep(0.02)
"""


def _with_a_hole() -> tuple[int, int]:
    program = subprocess.Popen([sys.executable, "-c", _SENDER, str(_domain())])
    try:
        with connection.open_transport("ros2", NetworkOptions(ros_domain_id=_domain())) as node:
            (topic,) = transport.wait_for_topics(node, ["/image"], 60.0)
            assert not topic.is_reliable
            counts = receiving.TopicCounts()
            node.subscribe(topic, lambda data: counts.stamp_of(data, is_ros_2=True))
            assert program.wait(60.0) == 0
            return counts.received, counts.missing
    finally:
        program.kill()


def test_lost_images_are_counted() -> None:
    """By best effort the first ones may be lost as well, before the two have found each other."""
    received, missing = own_process.in_own_process(_with_a_hole)
    assert missing == 10
    assert 60 < received <= 150


def _wrong_interface() -> str:
    try:
        with connection.open_transport("ros2", NetworkOptions(live_interface="203.0.113.9")):
            return ""
    except UserError as error:
        return str(error)


def test_an_address_that_this_computer_does_not_have_is_refused() -> None:
    assert "DDS cannot start" in own_process.in_own_process(_wrong_interface)


def test_the_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cyclonedds.builtin", None)
    with pytest.raises(UserError, match=r"pip install 'maplab-py\[ros2\]'"):
        ros2.Ros2(NetworkOptions())


def test_declared_types_have_the_fields_of_the_messages() -> None:
    from maplab_py.interop.live.ros2 import dds_type, type_hash

    odometry = dds_type("nav_msgs/msg/Odometry")
    names = list(odometry.__annotations__)
    assert names == ["header", "child_frame_id", "pose", "twist"]
    assert type_hash(IMU).startswith("RIHS01_7d9a00ff131080897a5ec7e26e315954")
    assert np.size(dds_type("sensor_msgs/msg/PointCloud2").__annotations__) == 1
