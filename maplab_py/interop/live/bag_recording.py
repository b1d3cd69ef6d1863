"""Recording of topics to a bag while messages arrive."""

import dataclasses
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.interop.live import transport as transports
from maplab_py.interop.live.connection import open_transport
from maplab_py.interop.live.options import NetworkOptions
from maplab_py.interop.recordings import bag_files, bag_writing
from maplab_py.options import Options, option
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report, counted

_MAX_WAITING = 20_000
"""Messages that may wait for the disk; beyond, they are left out and counted."""
_MAX_WAITING_BYTES = 1 << 30


class RecordingOptions(Options, prefix="record_"):
    """Topics and length of a recording."""

    topics: str = ""
    """Topics, separated by commas; empty = all of standard types"""
    duration_s: float = option(0.0, ge=0, lt=1e9)
    """End after so long; 0 = until Ctrl-C or silence"""

    @property
    def names(self) -> list[str]:
        """Topics to record; empty = all."""
        return [transports.topic_of(word) for word in self.topics.split(",") if word.strip()]


@dataclasses.dataclass(frozen=True)
class RecordedTopic:
    """One topic of the bag."""

    topic: str
    type: str
    messages: int


class RecordedBag(Report):
    """Result of a recording."""

    source: str
    bag: Path
    format: str
    duration_s: float
    topics: tuple[RecordedTopic, ...]
    notes: tuple[str, ...]


def record_bag(
    kind: str,
    path: Path,
    network: NetworkOptions,
    options: RecordingOptions,
    *,
    silence_s: float,
    overwrite: bool = False,
    progress: Progress = SILENT,
    is_to_end: Callable[[], bool] = lambda: False,
) -> RecordedBag:
    """Write topics to a bag until the user ends it.

    Args:
        kind: One of `TRANSPORTS`.
        path: File .bag for messages of ROS 1, folder for those of ROS 2 (mcap).
        silence_s: End when nothing has arrived for so long; 0 = never.
        is_to_end: Tells whether to end now, with what there is.

    Raises:
        FlagError: An option is wrong.
        UserError: A topic is missing, the bag cannot be written, or does not fit the messages.
    """
    names, bag_format = options.names, bag_writing.format_of_path(path)
    bag_writing.check_bag_writable(path, bag_format, overwrite=overwrite)
    with open_transport(kind, network) as transport:
        if transport.is_ros_2 != bag_format.is_ros_2:
            wanted = "a folder" if transport.is_ros_2 else "a file .bag"
            raise UserError(f"{path}: messages of {transport.name} go to {wanted}: name it so")
        topics = _topics(transport, names, network.live_wait_s)
        arrivals = _Arrivals(transport, topics, silence_s, options.duration_s)
        messages = arrivals.messages(progress, is_to_end)
        counts = bag_writing.write_bag(path, bag_format, messages, overwrite=overwrite)
        notes = [*transport.problems]
        if arrivals.dropped:
            notes.append(
                f"{counted(arrivals.dropped, 'message')} left out because the disk is too slow: "
                "record fewer topics, or smaller images"
            )
        return RecordedBag(
            transport.name,
            path,
            bag_format.value,
            arrivals.duration_s,
            tuple(RecordedTopic(t.name, t.type, counts.get(t.name, 0)) for t in topics),
            tuple(notes),
        )


def _topics(
    transport: transports.Transport, names: list[str], wait_s: float
) -> list[transports.Topic]:
    """Return the topics to record: those named, or all of standard types.

    Raises:
        UserError: One is not published, or has no standard type; or there is none.
    """
    known = bag_files.message_types(is_ros_2=transport.is_ros_2).fielddefs
    if names:
        topics = transports.wait_for_topics(transport, names, wait_s)
        for topic in topics:
            if topic.type not in known:
                raise UserError(
                    f"{topic.name} has messages of type {topic.type}, whose definition is not known: "
                    "leave it out of --record_topics"
                )
        return topics
    deadline_s = time.monotonic() + wait_s
    while time.monotonic() < deadline_s:
        topics = [t for t in transport.topics().values() if t.type in known]
        if topics:
            transports.pause(1.0)  # the others of the same robot
            return [t for t in transport.topics().values() if t.type in known]
        transports.pause()
    raise UserError(f"{transport.name}: nobody publishes anything ({wait_s:g} s waited)")


class _Arrivals:
    """Messages in the order of their arrival, on their way to the disk."""

    def __init__(
        self,
        transport: transports.Transport,
        topics: Sequence[transports.Topic],
        silence_s: float,
        duration_s: float,
    ) -> None:
        self.dropped, self.duration_s = 0, 0.0
        self._silence_s, self._longest_s = silence_s, duration_s
        self._queue: queue.Queue[bag_writing.BagMessage] = queue.Queue(_MAX_WAITING)
        self._waiting_bytes = 0
        for topic in topics:
            take = partial(self._take, bag_writing.Channel(topic.name, topic.type))
            transport.subscribe(topic, take)

    def _take(self, channel: bag_writing.Channel, data: bytes) -> None:
        """Keep a message; called by the receiving thread."""
        if self._waiting_bytes > _MAX_WAITING_BYTES:
            self.dropped += 1
            return
        try:
            self._queue.put_nowait(bag_writing.BagMessage(time.time_ns(), channel, bytes(data)))
            self._waiting_bytes += len(data)
        except queue.Full:
            self.dropped += 1

    def messages(
        self, progress: Progress, is_to_end: Callable[[], bool]
    ) -> Iterator[bag_writing.BagMessage]:
        """Yield messages until the end."""
        begin_s = heard_s = time.monotonic()
        count = size = 0
        last_ns = 0
        while not is_to_end() and not 0.0 < self._longest_s <= time.monotonic() - begin_s:
            try:
                message = self._queue.get(timeout=transports.LOOK_EVERY_S)
            except queue.Empty:
                if 0.0 < self._silence_s < time.monotonic() - heard_s:
                    break
                progress.check()
                continue
            heard_s = time.monotonic()
            self.duration_s = heard_s - begin_s
            self._waiting_bytes -= len(message.data)
            count, size = count + 1, size + len(message.data)
            # threads of ROS 1 may note their arrivals a moment out of order
            last_ns = max(last_ns, message.time_ns)
            progress.step(self.duration_s, 0.0, f"{count} messages, {size / 1e6:.0f} MB")
            yield message._replace(time_ns=last_ns)
