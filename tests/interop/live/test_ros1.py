"""Topics of ROS 1: headers, publishers that go and come, and a master that does."""

import socket
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplab_py.errors import UserError
from maplab_py.interop.live import ros1, transport
from maplab_py.interop.live.connection import open_transport
from maplab_py.interop.live.options import NetworkOptions
from tests.interop.live.support import IMU, imu_message, small_master
from tests.support.waiting import wait_until

pytest.importorskip("rosbags")

WORDS = st.text(st.characters(codec="ascii", exclude_characters="="), min_size=1, max_size=20)


@given(st.dictionaries(WORDS, WORDS, max_size=5))
def test_headers_are_read_as_they_were_written(fields: dict[str, str]) -> None:
    data = ros1.header_bytes(fields)
    assert struct.unpack_from("<I", data)[0] == len(data) - 4
    assert ros1.parse_header(data[4:]) == fields


@given(st.binary(max_size=200))
def test_damaged_headers_are_refused(data: bytes) -> None:
    with pytest.raises(ros1.ConnectionProblem, match="damaged"):
        ros1.parse_header(b"\x05\x00\x00\x00" + data.replace(b"=", b"")[:4])
    with pytest.raises(ros1.ConnectionProblem, match="damaged"):
        ros1.parse_header(ros1.header_bytes({"key": "value"})[4:] + b"\xff" + data)


@pytest.mark.parametrize(
    ("receive", "what"), [(ros1.receive_header, "header"), (ros1.receive_block, "message")]
)
def test_sizes_are_checked_before_memory_is_taken(receive: object, what: str) -> None:
    here, there = socket.socketpair()
    with here, there:
        there.sendall(struct.pack("<I", 2**32 - 1))
        with pytest.raises(
            ros1.ConnectionProblem, match=f"{what} of 4,294,967,295 bytes is refused"
        ):
            receive(here)  # type: ignore[operator]


def test_messages_pass_between_two_nodes() -> None:
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as robot, open_transport("ros1", network) as listener:
            publish = robot.advertise("/imu0", IMU)
            (topic,) = transport.wait_for_topics(listener, ["/imu0"], 5.0)
            assert topic == transport.Topic("/imu0", IMU)
            assert robot.topics() == {}  # its own do not count
            received: list[bytes] = []
            listener.subscribe(topic, received.append)
            assert wait_until(lambda: robot.subscribers("/imu0"))
            sent = [imu_message(t, is_ros_2=False) for t in (1, 2, 3)]
            for message in sent:
                publish(message)
            assert wait_until(lambda: len(received) == 3)
            assert received == sent


def test_a_publisher_that_starts_again_is_found() -> None:
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as listener:
            received: list[bytes] = []
            for round_number in range(2):
                with open_transport("ros1", network) as robot:
                    publish = robot.advertise("/imu0", IMU)
                    if not round_number:
                        listener.subscribe(transport.Topic("/imu0", IMU), received.append)
                    assert wait_until(lambda: robot.subscribers("/imu0"))
                    publish(imu_message(round_number + 1, is_ros_2=False))
                    assert wait_until(lambda n=round_number: len(received) == n + 1)
            assert wait_until(lambda: listener.problems)
            assert "/imu0: the publisher has closed the connection" in listener.problems


def test_a_master_that_starts_again_is_told_of_the_topics() -> None:
    with small_master() as master:
        network, port = NetworkOptions(ros_master_uri=master.uri), master.port
        listener_context = open_transport("ros1", network)
        listener = listener_context.__enter__()
        received: list[bytes] = []
        with open_transport("ros1", network) as robot:
            robot.advertise("/imu0", IMU)
            listener.subscribe(transport.Topic("/imu0", IMU), received.append)
            assert wait_until(lambda: robot.subscribers("/imu0"))
    assert wait_until(lambda: any("does not answer" in p for p in listener.problems))
    with small_master(port), open_transport("ros1", network) as robot:
        publish = robot.advertise("/imu0", IMU)
        assert wait_until(lambda: robot.subscribers("/imu0"))
        publish(imu_message(7, is_ros_2=False))
        assert wait_until(lambda: received)
        assert any("is there again" in problem for problem in listener.problems)
        listener_context.__exit__(None, None, None)


def test_a_subscriber_of_another_type_is_refused() -> None:
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri)
        with open_transport("ros1", network) as robot, open_transport("ros1", network) as listener:
            robot.advertise("/imu0", IMU)
            listener.subscribe(transport.Topic("/imu0", "nav_msgs/msg/Odometry"), lambda _: None)
            assert wait_until(lambda: listener.problems)
            assert "/imu0 has the type sensor_msgs/Imu" in listener.problems[0]


def test_no_master_is_said_with_the_remedy() -> None:
    network = NetworkOptions(ros_master_uri="http://127.0.0.1:1", live_wait_s=0.2)
    with (
        pytest.raises(
            UserError, match=r"does not answer .*: start roscore, or give --ros_master_uri"
        ),
        open_transport("ros1", network),
    ):
        pass


def test_an_unknown_interface_is_refused() -> None:
    with small_master() as master:
        network = NetworkOptions(ros_master_uri=master.uri, live_interface="nowhere0")
        with (
            pytest.raises(UserError, match="--live_interface=nowhere0: there is no such interface"),
            open_transport("ros1", network),
        ):
            pass


def test_it_listens_on_the_loopback_alone() -> None:
    with (
        small_master() as master,
        open_transport("ros1", NetworkOptions(ros_master_uri=master.uri)) as node,
    ):
        assert node._server.getsockname()[0] == "127.0.0.1"  # type: ignore[attr-defined]
        assert node._api.startswith("http://127.0.0.1:")  # type: ignore[attr-defined]
