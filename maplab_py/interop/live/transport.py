"""Common interface of the ways to topics."""

import contextlib
import socket
import struct
import sys
import time
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

from maplab_py.cancellation import current_token
from maplab_py.errors import Cancelled, UserError
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.recordings.bag_files import listed_topics

MAX_MESSAGE_BYTES = 200_000_000
"""Larger messages are refused before memory is reserved for them; an image of 60 megapixels fits."""
SOCKET_BYTES = 8 << 20
RAISE_RECEIVE_BUFFERS = f"sudo sysctl -w net.core.rmem_max={SOCKET_BYTES}"
LOOPBACK = "127.0.0.1"
LOOK_EVERY_S = 0.1
"""Interval at which waiting loops look for messages, publishers and the end."""
_SIOCGIFADDR = 0x8915  # <linux/sockios.h>

_T = TypeVar("_T")
Take = Callable[[bytes], None]
"""Is called with each message, in the thread that receives it."""
Publish = Callable[[bytes], None]
"""Sends a serialised message."""


class Topic(NamedTuple):
    """A topic that somebody publishes."""

    name: str
    type: str  # as in "sensor_msgs/msg/Image"
    publishers: int = 1
    is_reliable: bool = True  # all publishers offer it (ROS 2)


class Transport(Protocol):
    """A connection to the topics of a robot."""

    @property
    def name(self) -> str:
        """Place of the topics, as in "ROS 2 domain 0"."""

    @property
    def is_ros_2(self) -> bool:
        """Whether messages are CDR; else they are those of ROS 1."""

    @property
    def problems(self) -> list[str]:
        """Failures since the beginning, one line each."""

    def topics(self) -> dict[str, Topic]:
        """Return the topics that are published now, by name."""

    def subscribe(self, topic: Topic, take: Take) -> None:
        """Call a function with every message of a topic from now on."""

    def advertise(self, topic: str, kind: str) -> Publish:
        """Announce messages of a type; return what sends them."""

    def subscribers(self, topic: str) -> int:
        """Return how many listen to an advertised topic."""

    def close(self) -> None:
        """End all connections and threads."""


def wait_for_topics(transport: Transport, names: list[str], wait_s: float) -> list[Topic]:
    """Wait until all topics are published; return them.

    Raises:
        UserError: They are not, in time; the message lists those that are.
        Cancelled: The user does not want to wait.
    """
    deadline_s = time.monotonic() + wait_s
    while True:
        seen = transport.topics()
        if all(name in seen for name in names):
            return [seen[name] for name in names]
        if time.monotonic() > deadline_s:
            break
        pause()
    missing = ", ".join(name for name in names if name not in seen)
    listed = listed_topics({topic.name: topic.type for topic in seen.values()})
    problem = f"; {transport.problems[-1]}" if transport.problems else ""
    raise UserError(
        f"{transport.name}: nobody publishes {missing} ({wait_s:g} s waited): start the publisher, or "
        f"choose other topics; seen: {listed}{problem}"
    )


def topic_of(name: str) -> str:
    """Return the full name of a topic as the user writes it."""
    return f"/{name.strip().strip('/')}"


def answer_of(ask: Callable[[], _T], wait_s: float) -> _T:
    """Ask until there is an answer; a robot may start later than this program.

    Raises:
        UserError: There is none in time.
        Cancelled: The user does not want to wait.
    """
    deadline_s = time.monotonic() + wait_s
    while True:
        try:
            return ask()
        except UserError:
            if time.monotonic() > deadline_s:
                raise
        pause()


def pause(wait_s: float = LOOK_EVERY_S) -> None:
    """Wait a moment, unless the user wants the end.

    Raises:
        Cancelled: The user does.
    """
    token = current_token()
    token.check()
    if token.is_ending:
        raise Cancelled("ended before anything arrived")
    time.sleep(wait_s)


def listening_address(network: NetworkOptions) -> str:
    """Return the IP address to listen on.

    Raises:
        UserError: The interface is unknown.
    """
    name = network.live_interface
    if not name:
        return LOOPBACK
    with contextlib.suppress(OSError):
        socket.inet_aton(name)
        return name
    if sys.platform == "linux":
        import fcntl

        request = struct.pack("256s", name.encode()[:15])
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
        ):
            answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
            return socket.inet_ntoa(answer[20:24])
    known = ", ".join(entry for _, entry in socket.if_nameindex())
    raise UserError(
        f"--live_interface={name}: there is no such interface with an IPv4 address: give one of "
        f"{known}, or the IP address of one"
    )
