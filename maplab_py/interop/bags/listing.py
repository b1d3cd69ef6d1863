"""Content of a bag, whatever its messages are."""

import dataclasses
from pathlib import Path

from maplab_py.interop.bags.sensor_messages import COMPRESSED, IMAGE
from maplab_py.interop.recordings import bag_files, bag_writing
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report

_PROGRESS_EVERY = 1000
_IMAGES = (IMAGE, COMPRESSED)
_NS_TO_S = 1e-9


@dataclasses.dataclass(frozen=True)
class BagTopic:
    """A topic of a bag; times are those of arrival."""

    topic: str
    type: str
    messages: int
    start_s: float | None  # after the bag's first message
    duration_s: float
    rate_hz: float


@dataclasses.dataclass(frozen=True)
class BagImages:
    """Storage of the images of a topic."""

    topic: str
    encoding: str  # or format, of the first image


class BagInfo(Report):
    """Content of a bag."""

    bag: Path
    format: str
    start_ns: int | None
    duration_s: float
    messages: int
    topics: tuple[BagTopic, ...]
    images: tuple[BagImages, ...] = ()


@dataclasses.dataclass
class _Times:
    type: str
    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    encoding: str = ""

    def add(self, time_ns: int) -> None:
        """Count a message."""
        self.first_ns = min(self.first_ns, time_ns) if self.count else time_ns
        self.last_ns = max(self.last_ns, time_ns) if self.count else time_ns
        self.count += 1


def bag_info(path: Path, *, progress: Progress = SILENT) -> BagInfo:
    """Read all messages of a bag and list its topics.

    Raises:
        UserError: It is no bag, or the library is missing.
        MapError: It is damaged or has no index.
    """
    bag_files.check_bag(path, "--bag")
    topics: dict[tuple[str, str], _Times] = {}
    with bag_files.opened_bag(path) as reader:
        for connection in reader.connections:
            topics[connection.topic, connection.msgtype] = _Times(connection.msgtype)
        total = reader.message_count
        messages = bag_files.all_messages(path, reader, list(reader.connections))
        for done, (connection, time_ns, data) in enumerate(messages):
            if done % _PROGRESS_EVERY == 0:
                progress.step(done, total, "messages")
            times = topics[connection.topic, connection.msgtype]
            if not times.count and times.type in _IMAGES:
                image = reader.deserialize(data, times.type)
                times.encoding = image.encoding if times.type == IMAGE else image.format
            times.add(time_ns)
    heard = [times for times in topics.values() if times.count]
    start_ns = min((times.first_ns for times in heard), default=None)
    end_ns = max((times.last_ns for times in heard), default=0)
    return BagInfo(
        bag=path,
        format=bag_writing.format_of_bag(path).value,
        start_ns=start_ns,
        duration_s=0.0 if start_ns is None else (end_ns - start_ns) * _NS_TO_S,
        messages=sum(times.count for times in heard),
        topics=tuple(
            _topic(topic, times, start_ns or 0) for (topic, _), times in sorted(topics.items())
        ),
        images=tuple(
            BagImages(topic, times.encoding)
            for (topic, _), times in sorted(topics.items())
            if times.encoding
        ),
    )


def _topic(topic: str, times: _Times, start_ns: int) -> BagTopic:
    duration_s = (times.last_ns - times.first_ns) * _NS_TO_S
    return BagTopic(
        topic=topic,
        type=times.type,
        messages=times.count,
        start_s=(times.first_ns - start_ns) * _NS_TO_S if times.count else None,
        duration_s=duration_s,
        rate_hz=(times.count - 1) / duration_s if duration_s > 0.0 else 0.0,
    )
