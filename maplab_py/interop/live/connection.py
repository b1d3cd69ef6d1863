"""Connecting to the topics of a robot."""

import contextlib
import dataclasses
import importlib
import time
from collections.abc import Iterator
from functools import partial

from maplab_py.errors import FlagError, UserError
from maplab_py.interop.live.options import TRANSPORTS, NetworkOptions
from maplab_py.interop.live.transport import LOOK_EVERY_S, Topic, Transport
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report

_CLASSES = {
    "ros2": ("ros2", "Ros2"),
    "ros1": ("ros1", "Ros1"),
    "foxglove": ("foxglove", "FoxgloveClient"),
    "foxglove_server": ("foxglove", "FoxgloveServer"),
}
"""File and class of each transport; their libraries may be missing."""


@contextlib.contextmanager
def open_transport(
    kind: str, network: NetworkOptions, *, is_server: bool = False
) -> Iterator[Transport]:
    """Connect to ROS 2, ROS 1 or Foxglove, as one of `TRANSPORTS` says.

    Args:
        kind: One of `TRANSPORTS`.
        is_server: Be the server of Foxglove, in place of its client.

    Raises:
        UserError: The transport is unknown, a library is missing, or nobody answers.
    """
    if kind not in TRANSPORTS:
        raise UserError(f"transport {kind}: wants one of {', '.join(TRANSPORTS)}")
    file, name = _CLASSES[kind + "_server" * (is_server and kind == "foxglove")]
    module = importlib.import_module(f"maplab_py.interop.live.{file}")
    transport: Transport = getattr(module, name)(network)
    try:
        yield transport
    finally:
        transport.close()


# The topics of running robots as a table.


@dataclasses.dataclass(frozen=True)
class LiveTopic:
    """One topic."""

    topic: str
    type: str
    publishers: int
    rate_hz: float | None  # None = the type is no standard message, so it was not received
    megabytes_per_s: float | None
    reliable: bool


class LiveTopics(Report):
    """Topics that running robots publish."""

    source: str
    topics: tuple[LiveTopic, ...]
    notes: tuple[str, ...]

    @property
    def failure(self) -> str:
        """Say so if there is nothing."""
        return "" if self.topics else f"{self.source}: nobody publishes anything"

    @property
    def advice(self) -> str:
        """Return what to check when there is nothing."""
        return (
            ""
            if self.topics
            else "check that the robot runs, the domain (ROS_DOMAIN_ID) or master, and --live_interface "
            "for robots beyond this computer"
        )


def list_topics(
    kind: str, network: NetworkOptions, listen_s: float, *, progress: Progress = SILENT
) -> LiveTopics:
    """Listen to all topics for a while, and return what there is.

    Raises:
        FlagError: The time is not positive.
        UserError: The transport is unknown, a library is missing, or nobody answers.
    """
    if not 0.0 < listen_s < 1e6:
        raise FlagError(f"--listen_s={listen_s:g}: must be greater than 0")
    with open_transport(kind, network) as transport:
        sizes = _listen(transport, listen_s, progress)
        topics = transport.topics()
        listed = tuple(_row(topics[name], sizes, listen_s) for name in sorted(topics))
        return LiveTopics(transport.name, listed, tuple(transport.problems))


def _listen(transport: Transport, listen_s: float, progress: Progress) -> dict[str, list[int]]:
    """Return the sizes of the messages of each topic of a standard type."""
    known = message_types(is_ros_2=transport.is_ros_2).fielddefs
    sizes: dict[str, list[int]] = {}
    begin_s = time.monotonic()
    while (done_s := time.monotonic() - begin_s) < listen_s:
        progress.step(done_s, listen_s, "listening")
        for name, topic in transport.topics().items():
            if name not in sizes and topic.type in known:
                sizes[name] = []
                transport.subscribe(topic, partial(_note_size, sizes[name]))
        time.sleep(LOOK_EVERY_S)
    return sizes


def _note_size(sizes: list[int], data: bytes) -> None:
    sizes.append(len(data))


def _row(topic: Topic, sizes: dict[str, list[int]], listen_s: float) -> LiveTopic:
    received = sizes.get(topic.name)
    return LiveTopic(
        topic.name,
        topic.type,
        topic.publishers,
        None if received is None else len(received) / listen_s,
        None if received is None else sum(received) / listen_s * 1e-6,
        topic.is_reliable,
    )
