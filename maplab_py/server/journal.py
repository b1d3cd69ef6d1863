"""The journal: what the server knows besides the map, and how it finds its way after a crash.

The map itself tells which submaps it has: those whose vertices are in it. The journal is written after
the map; what it does not know yet is completed from the map and the spool (see `Server.recover`).
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from maplab_py.atomic import write_file
from maplab_py.errors import UserError
from maplab_py.server.merging import Stretch

_FORMAT = 1


@dataclasses.dataclass(frozen=True)
class MergedSubmap:
    """A submap that is in the map."""

    number: int
    robot: str
    name: str
    sha256: str
    stretches: tuple[Stretch, ...]

    @property
    def title(self) -> str:
        """Robot and name."""
        return f"{self.robot}/{self.name}"


@dataclasses.dataclass(frozen=True)
class Journal:
    """State of a server.

    Attributes:
        merged: Submaps in the map, in the order in which they were merged.
        robots: Robot of each mission (id).
        deleted: Missions (ids) that were deleted; their submaps are refused.
        since_joint: Submaps that were merged since the last joint optimisation.
        since_reset: Submaps that were merged since the trust region was reset.
        joint_is_due: A joint optimisation is needed at the next pause.
        radius: Trust region of the last joint optimisation; 0 = the default.
    """

    merged: tuple[MergedSubmap, ...] = ()
    robots: dict[str, str] = dataclasses.field(default_factory=dict)
    deleted: tuple[str, ...] = ()
    since_joint: int = 0
    since_reset: int = 0
    joint_is_due: bool = False
    radius: float = 0.0

    def with_merged(self, submap: MergedSubmap, *, joint_is_due: bool = False) -> Journal:
        """Return the journal after a submap has been merged."""
        robots = {**self.robots, **{s.mission: submap.robot for s in submap.stretches}}
        return dataclasses.replace(
            self,
            merged=(*self.merged, submap),
            robots=robots,
            since_joint=self.since_joint + 1,
            since_reset=self.since_reset + 1,
            joint_is_due=self.joint_is_due or joint_is_due,
        )

    def without_missions(self, missions: set[str]) -> Journal:
        """Return the journal after missions have been deleted."""
        merged = []
        for submap in self.merged:
            kept = tuple(s for s in submap.stretches if s.mission not in missions)
            if kept:
                merged.append(dataclasses.replace(submap, stretches=kept))
        deleted = (*self.deleted, *sorted(missions - set(self.deleted)))
        return dataclasses.replace(self, merged=tuple(merged), deleted=deleted)


def read_journal(path: Path) -> Journal:
    """Read a journal; an empty one where there is no file.

    Raises:
        UserError: It is damaged.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("format") != _FORMAT:
            raise ValueError("format")
        merged = []
        for item in content.pop("merged"):
            stretches = tuple(Stretch(**stretch) for stretch in item.pop("stretches"))
            merged.append(MergedSubmap(**item, stretches=stretches))
        deleted = tuple(content.pop("deleted"))
        return Journal(merged=tuple(merged), deleted=deleted, **content)
    except FileNotFoundError:
        return Journal()
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: is damaged; delete it to rebuild it from the map") from error


def write_journal(journal: Journal, path: Path) -> None:
    """Write a journal, completely or not at all; raises UserError."""
    content = {"format": _FORMAT, **dataclasses.asdict(journal)}
    write_file(path, [json.dumps(content).encode("utf-8", "surrogatepass")])
