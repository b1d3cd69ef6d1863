"""The journal: what the server knows besides the map, and how it finds its way after a crash.

The map itself tells which submaps it has: those whose vertices are in it. The journal is written after
the map; what it does not know yet is completed from the map and the spool (see `Server.recover`).
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.atomic import write_file
from maplab_py.errors import MaplabError, UserError
from maplab_py.server.merging import Stretch, stretches_of
from maplab_py.server.spool import Entry, Spool
from maplab_py.storage.native import is_map_folder, load_map
from maplab_py.vimap import VIMap, edits, to_hex_list

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
    """State of a server."""

    # submaps in the map, in the order in which they were merged
    merged: tuple[MergedSubmap, ...] = ()
    robots: dict[str, str] = dataclasses.field(default_factory=dict)  # robot of each mission (id)
    deleted: tuple[str, ...] = ()  # missions (ids) that were deleted; their submaps are refused
    since_joint: int = 0  # submaps that were merged since the last joint optimisation
    since_reset: int = 0  # submaps that were merged since the trust region was reset
    joint_is_due: bool = False  # a joint optimisation is needed at the next pause
    radius: float = 0.0  # trust region of the last joint optimisation; 0 = the default

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


# Recovery of a server at its start: map, journal and spool, brought to agree.
#
# The map is the truth: a submap is in it when its vertices are. The journal may lag behind by what was
# published last, and the map behind the journal where somebody has put a backup in its place.


@dataclasses.dataclass(frozen=True, eq=False)
class Recovered:
    """State at which the server continues."""

    vi_map: VIMap | None  # the published map; None without one
    journal: Journal  # what it consists of
    notes: tuple[str, ...]  # what was brought to agree
    is_changed: bool  # the map was changed and must be published


def recover(spool: Spool, map_folder: Path) -> Recovered:
    """Read map and journal; submaps in `accepted` that the map has go to `merged`, and back.

    Raises:
        UserError: The journal is damaged, the map cannot be loaded, or it was not made from this spool.
    """
    spool.clean()
    journal, notes = read_journal(spool.journal), []
    vi_map = load_map(map_folder)[0] if is_map_folder(map_folder) else None
    is_changed = False
    if vi_map is not None and journal.deleted:
        mask = np.isin(to_hex_list(vi_map.missions.id), journal.deleted)
        if mask.any():
            is_changed, vi_map = True, _without(vi_map, mask)
    journal, lost = _without_lost(spool, journal, vi_map)
    notes += lost
    journal, added = _with_unknown(spool, journal, vi_map)
    notes += added
    if vi_map is not None:
        strange = set(to_hex_list(vi_map.missions.id)) - set(journal.robots)
        if strange:
            raise UserError(
                f"--maplab_server_merged_map_folder={map_folder} holds mission {min(strange)}, which "
                f"did not come through {spool.root}: choose another folder"
            )
    return Recovered(vi_map, journal, tuple(notes), is_changed)


def _without(vi_map: VIMap, mask: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> VIMap | None:
    return None if mask.all() else edits.remove_missions(vi_map, mask)


def _without_lost(
    spool: Spool, journal: Journal, vi_map: VIMap | None
) -> tuple[Journal, list[str]]:
    """Take submaps back to `accepted` that the journal knows and the map has not."""
    kept, notes = [], []
    for submap in journal.merged:
        if vi_map is not None and all(s.is_in(vi_map) for s in submap.stretches):
            kept.append(submap)
        elif spool.take_back(submap.number):
            notes.append(f"{submap.title}: is not in the map; it is merged again")
        elif any(entry.number == submap.number for entry in spool.entries()):
            continue  # was on its way
        else:
            notes.append(f"{submap.title}: is not in the map, and its folder was not kept")
    return dataclasses.replace(journal, merged=tuple(kept)), notes


def _with_unknown(
    spool: Spool, journal: Journal, vi_map: VIMap | None
) -> tuple[Journal, list[str]]:
    """Add submaps that the map has and the journal does not know; those in `accepted` move on."""
    notes: list[str] = []
    if vi_map is None:
        return journal, notes
    known = {submap.number for submap in journal.merged}
    for entry in spool.entries():
        if entry.number in known:
            spool.finish(entry, keep=True)
            continue
        record = _if_in_map(spool.folder(entry) / "submap", entry, vi_map)
        if record is not None:
            journal = journal.with_merged(record, joint_is_due=True)
            spool.finish(entry, keep=True)
            notes.append(f"{entry.title}: was merged before the server ended")
    if not journal.robots:  # the journal was deleted
        for folder in sorted(spool.merged.glob("[0-9]*")):
            entry = Entry(**json.loads((folder / "entry.json").read_text(encoding="utf-8")))
            record = _if_in_map(folder / "submap", entry, vi_map)
            if record is not None and entry.number not in known:
                journal = journal.with_merged(record, joint_is_due=True)
    return journal, notes


def _if_in_map(folder: Path, entry: Entry, vi_map: VIMap) -> MergedSubmap | None:
    """Return the record of a submap if all its vertices are in the map."""
    try:
        submap, _ = load_map(folder)
    except MaplabError:
        return None  # the worker will say why
    if not len(submap.vertices) or (vi_map.vertex_index.rows(submap.vertices.id) < 0).any():
        return None
    stretches = tuple(stretches_of(submap))
    return MergedSubmap(entry.number, entry.robot, entry.name, entry.sha256, stretches)
