"""The spool: folders through which submaps go from robots into the map.

    incoming/ROBOT/NAME             a submap that a robot has put there by one rename
    incoming/.partial/              copies that `push` has not finished
    accepted/000012/entry.json      who sent it, and its SHA-256
                   /submap/         the submap as it came
                   /prepared/       the same after its own optimisation
                   /prepared.sha256 of how it was made: a later server uses it if it would do the same
                   /worker.log
    merged/000012/                  the same folder, once the published map has the submap
    rejected/000012/                the same folder, with reason.txt
    journal.json, server.json, server.log, .server.lock

Every step of a submap is one rename in the spool, so a crash leaves it in one folder or in the next.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.atomic import move_folder, system, write_file
from maplab_py.errors import MapError, UserError, os_errors_as
from maplab_py.pipeline.records import folder_hash
from maplab_py.storage import checksums, native
from maplab_py.storage.resources.store import MAP_FOLDER
from maplab_py.vimap import VIMap, merge

_PUSHED = ".pushed.json"
QUIET_S = 5.0
"""A folder that is no sound map, or has no checksums, is left alone until nothing has changed in it for so
long [s]: it may still be being copied."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A submap in the spool."""

    number: int  # counts the accepted submaps
    robot: str  # who sent it
    name: str  # name of its folder in `incoming/ROBOT`
    sha256: str  # of the names and contents of its files
    accepted_s: float  # when it was accepted [s since 1970]

    @property
    def title(self) -> str:
        """Robot and name."""
        return f"{self.robot}/{self.name}"


@dataclasses.dataclass(frozen=True)
class Arrival:
    """A folder in `incoming/ROBOT`: complete, unfinished, or with a reason not to take it."""

    robot: str
    folder: Path
    is_complete: bool
    reason: str = ""


class Spool:
    """The folders of a spool."""

    def __init__(self, root: Path, *, quiet_s: float = QUIET_S) -> None:
        """Use a folder, which need not exist."""
        self.root, self._quiet_s = root.absolute(), quiet_s
        self.incoming = self.root / "incoming"
        self.partial = self.incoming / ".partial"
        self.accepted = self.root / "accepted"
        self.merged = self.root / "merged"
        self.rejected = self.root / "rejected"
        self.journal = self.root / "journal.json"
        self.address = self.root / "server.json"
        self.log = self.root / "server.log"
        self.lock = self.root / ".server.lock"

    def make(self) -> None:
        """Make the folders that are missing.

        Raises:
            UserError: They cannot be made.
        """
        try:
            for folder in (self.partial, self.accepted, self.merged, self.rejected):
                folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"--spool={self.root}: {error.strerror}: {error.filename}") from error

    def check_exists(self) -> None:
        """Check that this is a spool; raises UserError."""
        if not self.incoming.is_dir():
            raise UserError(f"--spool={self.root} is no spool: start one with maplab serve")

    def arrivals(self) -> list[Arrival]:
        """Return what lies in `incoming`, the oldest first."""
        arrivals = []
        for robot in _folders(self.incoming):
            if not robot.is_symlink():
                arrivals += [_arrival(robot.name, path, self._quiet_s) for path in _folders(robot)]
        return sorted(arrivals, key=lambda a: (_changed_s(a.folder), a.robot, a.folder.name))

    def accept(self, arrival: Arrival, number: int) -> Entry:
        """Move a submap from `incoming` to `accepted`.

        Raises:
            UserError: A file cannot be read or written.
        """
        sha256 = folder_hash(arrival.folder)
        entry = Entry(number, arrival.robot, arrival.folder.name, sha256, time.time())
        folder = self.folder(entry)
        text = json.dumps(dataclasses.asdict(entry)) + "\n"
        write_file(folder / "entry.json", [text.encode("utf-8", "surrogatepass")])
        move_folder(arrival.folder, folder / "submap")
        return entry

    def folder(self, entry: Entry) -> Path:
        """Return the folder of an accepted submap."""
        return self.accepted / _name(entry)

    def entries(self) -> list[Entry]:
        """Return the accepted submaps by number."""
        entries = []
        for folder in _folders(self.accepted):
            try:
                entry = Entry(**json.loads((folder / "entry.json").read_text(encoding="utf-8")))
            except (OSError, ValueError, TypeError):
                continue
            if (folder / "submap").is_dir():
                entries.append(entry)
        return sorted(entries, key=lambda entry: entry.number)

    def clean(self) -> None:
        """Delete what crashes have left; only the server, which holds the lock, may call this."""
        for folder in _folders(self.accepted):
            if not (folder / "submap").exists():
                shutil.rmtree(folder, ignore_errors=True)

    def highest_number(self) -> int:
        """Return the largest number that was given to a submap, 0 without any."""
        parents = (self.accepted, self.merged, self.rejected)
        names = [folder.name for parent in parents for folder in _folders(parent)]
        return max((int(name) for name in names if name.isdigit()), default=0)

    def reject(self, entry: Entry, reason: str) -> None:
        """Move a submap to `rejected` with a text file that says why."""
        folder = self.folder(entry)
        line = f"{entry.title}: {reason}\n"
        write_file(folder / "reason.txt", [line.encode("utf-8", "surrogatepass")])
        shutil.rmtree(folder / "prepared", ignore_errors=True)
        move_folder(folder, self.rejected / folder.name)

    def finish(self, entry: Entry, *, keep: bool) -> None:
        """Move a submap to `merged`, or delete it."""
        folder = self.folder(entry)
        shutil.rmtree(folder / "prepared", ignore_errors=True)
        if keep:
            move_folder(folder, self.merged / folder.name)
        else:
            shutil.rmtree(folder, ignore_errors=True)

    def take_back(self, number: int) -> bool:
        """Move a merged submap back to `accepted`; False where it was not kept."""
        name = f"{number:06d}"
        if not (self.merged / name).is_dir():
            return False
        move_folder(self.merged / name, self.accepted / name)
        return True


def push(spool: Spool, robot: str, submap: Path, name: str = "") -> Path:
    """Copy a submap into a spool: completely, checked, and then by one rename.

    Args:
        spool: Where to.
        robot: Name of the robot.
        submap: Map folder.
        name: Name in the spool; empty = that of the folder.

    Returns:
        The folder in `incoming`.

    Raises:
        UserError: The folder is no map, a name cannot be a folder's, the spool has it already, the
            copy differs, or the disk refuses.
    """
    spool.make()
    name = name or submap.resolve().name
    for flag, text in (("robot_name", robot), ("name", name)):
        if not text or "/" in text or text.startswith(".") or "\0" in text:
            raise UserError(f"--{flag}={text}: must be a name without / that begins with no dot")
    if not native.is_map_folder(submap):
        raise UserError(f"{submap} is not a map folder")
    target = spool.incoming / robot / name
    if target.exists():
        raise UserError(f"{target} is there already: give another --name")
    digest = folder_hash(submap)
    copy = spool.partial / uuid.uuid4().hex
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(submap, copy)
        if folder_hash(copy) != digest:
            raise UserError(f"{submap}: the copy in {spool.root} differs; push it again")
        write_file(copy / _PUSHED, [json.dumps({"sha256": digest}).encode()])
        move_folder(copy, target)
    except (OSError, shutil.Error) as error:
        reason = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise UserError(f"{target}: cannot be written ({reason})") from error
    finally:
        shutil.rmtree(copy, ignore_errors=True)
    return target


def _arrival(robot: str, folder: Path, quiet_s: float) -> Arrival:
    """Judge a folder by its checksums; those of `push` are compared where there are some."""
    if folder.is_symlink():
        return Arrival(robot, folder, False, "is a symbolic link: put the folder itself there")
    try:
        reason = "" if native.is_map_folder(folder) else "is no complete map folder"
        if not reason:
            checksums.verify(folder)
            pushed = folder / _PUSHED
            if pushed.is_file():
                expected = json.loads(pushed.read_text(encoding="utf-8")).get("sha256")
                reason = "" if folder_hash(folder) == expected else "differs from what was pushed"
    except (MapError, UserError) as error:
        reason = str(error)
    except (OSError, ValueError, AttributeError) as error:
        reason = f"cannot be read ({error})"
    is_sealed = (folder / checksums.FILE_NAME).is_file() or (folder / _PUSHED).is_file()
    if not reason and is_sealed:
        return Arrival(robot, folder, True)
    if time.time() - _changed_s(folder) < quiet_s:
        return Arrival(robot, folder, False)
    return Arrival(robot, folder, not reason, reason)


def _name(entry: Entry) -> str:
    return f"{entry.number:06d}"


def _folders(parent: Path) -> list[Path]:
    """Return the folders in a folder that are not hidden, by name."""
    try:
        return sorted(p for p in parent.iterdir() if p.is_dir() and not p.name.startswith("."))
    except OSError:
        return []


def _changed_s(folder: Path) -> float:
    """Return when the folder or a file in it last changed [s since 1970]."""
    times = [folder.lstat().st_ctime] if folder.exists() else [0.0]
    for path in folder.rglob("*"):
        try:
            times.append(path.lstat().st_ctime)
        except OSError:
            continue
    return max(times)


def with_resources_taken_in(whole: VIMap, submap: VIMap) -> VIMap:
    """Return a map whose own folder has the resources that were in a submap's own folder.

    Maps that are joined refer to the resource folder of the second one as to an external folder. The server
    brings the files of submaps to the folder of its map instead (`Publisher.with_resources`).
    """
    folders = whole.metadata.external_resource_folders
    name = merge.resource_folder_name(submap.metadata)
    if name not in folders:
        return whole
    index, folder = folders.index(name), whole.resources.folder
    left = folder - (folder > index).astype(folder.dtype)
    metadata = dataclasses.replace(
        whole.metadata, external_resource_folders=folders[:index] + folders[index + 1 :]
    )
    resources = whole.resources.replace(folder=np.where(folder == index, MAP_FOLDER, left))
    return whole.replace(resources=resources, metadata=metadata)


@contextlib.contextmanager
def locked_spool(spool: Spool) -> Iterator[None]:
    """Hold the lock of a spool; the system releases it when the process ends, however it ends.

    Raises:
        UserError: Another process holds it, or it cannot be made.
    """
    with os_errors_as(UserError, f"{spool.lock}: cannot be locked"):
        descriptor = system.opened_locked(spool.lock)
    if descriptor is None:
        raise UserError(
            f"--spool={spool.root}: another server{_process(spool)} works on it; stop it with "
            "serve_stop, or give another spool"
        )
    try:
        yield
    finally:
        os.close(descriptor)


def _process(spool: Spool) -> str:
    try:
        return f" (process {int(json.loads(spool.address.read_text())['process'])})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
