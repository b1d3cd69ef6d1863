"""Reports of writing and reading bags."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class WrittenTopic:
    """A topic of a bag that was written."""

    topic: str
    messages: int


@dataclasses.dataclass(frozen=True)
class BagReport(Report):
    """A bag that was written."""

    bag: Path
    format: str
    missions: tuple[str, ...]
    messages: int
    copied_messages: int
    topics: tuple[WrittenTopic, ...]
    notes: tuple[str, ...] = ()


def written_topics(counts: Mapping[str, int]) -> tuple[WrittenTopic, ...]:
    """Return the topics with their numbers of messages, by name."""
    return tuple(WrittenTopic(topic, count) for topic, count in sorted(counts.items()))


@dataclasses.dataclass(frozen=True)
class BagImport(Report):
    """Messages that became resources of a mission; their files are written when the map is saved."""

    mission: str
    topic: str
    type: str
    messages: int
    resource_types: tuple[str, ...]
    attached: int
    had_some: int = dataclasses.field(
        metadata={"title": "with a resource before"}
    )  # frames or clouds
    frames_without_message: int = 0
    messages_outside_mission: int = 0
    camera: int | None = None
    calibration_difference_px: float | None = None
    notes: tuple[str, ...] = ()
