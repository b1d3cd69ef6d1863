"""Content of a bag, whatever its messages are."""

from __future__ import annotations

import dataclasses
from array import array
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


def bag_info(path: Path, *, progress: Progress = SILENT) -> BagInfo:
    """Read all messages of a bag and list its topics.

    Raises:
        UserError: It is no bag, or the library is missing.
        MapError: It is damaged or has no index.
    """
    bag_files.check_bag(path, "--bag")
    encodings: dict[str, str] = {}
    with bag_files.opened_bag(path) as reader:
        arrivals = {(c.topic, c.msgtype): array("q") for c in reader.connections}
        total = reader.message_count
        messages = bag_files.all_messages(path, reader, list(reader.connections))
        for done, (connection, time_ns, data) in enumerate(messages):
            if done % _PROGRESS_EVERY == 0:
                progress.step(done, total, "messages")
            topic, kind = connection.topic, connection.msgtype
            if topic not in encodings and kind in _IMAGES:
                image = reader.deserialize(data, kind)
                encodings[topic] = image.encoding if kind == IMAGE else image.format
            arrivals[topic, kind].append(time_ns)
    heard = [times for times in arrivals.values() if times]
    start_ns = min(map(min, heard), default=None)
    end_ns = max(map(max, heard), default=0)
    return BagInfo(
        bag=path,
        format=bag_writing.format_of_bag(path).value,
        start_ns=start_ns,
        duration_s=0.0 if start_ns is None else (end_ns - start_ns) * _NS_TO_S,
        messages=sum(map(len, heard)),
        topics=tuple(
            _topic(topic, kind, times, start_ns or 0)
            for (topic, kind), times in sorted(arrivals.items())
        ),
        images=tuple(BagImages(*item) for item in sorted(encodings.items()) if item[1]),
    )


def _topic(topic: str, kind: str, times: array[int], start_ns: int) -> BagTopic:
    first_ns, last_ns = (min(times), max(times)) if times else (0, 0)
    duration_s = (last_ns - first_ns) * _NS_TO_S
    return BagTopic(
        topic=topic,
        type=kind,
        messages=len(times),
        start_s=(first_ns - start_ns) * _NS_TO_S if times else None,
        duration_s=duration_s,
        rate_hz=(len(times) - 1) / duration_s if duration_s > 0.0 else 0.0,
    )
