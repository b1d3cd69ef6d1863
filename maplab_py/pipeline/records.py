"""Records of finished tasks: what a later run needs to know that it need not run them again."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maplab_py.atomic import write_file
from maplab_py.errors import UserError
from maplab_py.pipeline.plan import MAP_TEMPLATE, Stage
from maplab_py.storage.map_saving import CARD_FILE

FOLDER = "tasks"
"""Folder of records, logs and reports in the folder of results."""
_FORMAT = 1


@dataclasses.dataclass(frozen=True)
class Record:
    """A finished task."""

    format: int  # version of the record
    stage: str  # name of its stage
    name: str  # name of the task
    commands: tuple[str, ...]  # commands of its stage, before folders are put in
    flags: dict[str, str]  # lasting flags by name
    version: str  # version of maplab-py
    # map folders that it read, in their order, each with its SHA-256
    inputs: tuple[tuple[str, str], ...]
    result: str  # SHA-256 of the result
    seconds: float  # run time [s]
    peak_gb: float  # largest resident memory [GB]
    attempts: int  # how often it was started
    worker: str  # who finished it


def record_of(task: Task, flags: dict[str, str], version: str) -> Record:
    """Return the record of a task that is not finished: what a finished one must agree with."""
    stage = task.stage
    request = stage.name, task.name, stage.commands, flags, version
    return Record(_FORMAT, *request, (), "", 0.0, 0.0, 0, "")


class Records:
    """The records in a folder of results."""

    def __init__(self, results: Path) -> None:
        """Use a folder, which need not exist."""
        self.folder = results / FOLDER

    def path(self, task: Task, suffix: str) -> Path:
        """Return the path of one of a task's files: `.json`, `.jsonl` or `.log`."""
        return self.folder / task.stage.name / f"{task.name}{suffix}"

    def exist(self) -> bool:
        """Tell whether an earlier run has finished tasks."""
        return next(self.folder.glob("*/*.json"), None) is not None

    def read(self, task: Task) -> Record | None:
        """Return the record of a task, None where it is not finished.

        Raises:
            UserError: The record is damaged.
        """
        path = self.path(task, ".json")
        try:
            content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            commands = tuple(map(str, content["commands"]))
            inputs = tuple((str(folder), str(digest)) for folder, digest in content["inputs"])
            record = Record(**{**content, "commands": commands, "inputs": inputs})
            is_sound = record.format == _FORMAT and isinstance(record.flags, dict)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, TypeError, KeyError):
            is_sound = False
        if not is_sound:
            raise UserError(f"{path}: is damaged; delete it to run {task.title} again")
        return record

    def write(self, task: Task, record: Record) -> None:
        """Write the record of a finished task, completely or not at all."""
        text = json.dumps(dataclasses.asdict(record), indent=1, sort_keys=True) + "\n"
        write_file(self.path(task, ".json"), [text.encode()])

    def forget(self, task: Task) -> None:
        """Delete the record of a task that runs again."""
        self.path(task, ".json").unlink(missing_ok=True)


def change(old: Record, new: Record) -> str:
    """Return in words what differs in commands, flags and version; empty where nothing does.

    Differing inputs are no change of the request: their tasks simply run again.
    """
    if old.version != new.version:
        return f"maplab-py was {old.version} and is {new.version} now"
    for name in sorted(old.flags.keys() | new.flags.keys()):
        before, now = old.flags.get(name), new.flags.get(name)
        if before != now:
            return f"--{name} was {_given(before)} and is {_given(now)} now"
    if old.commands == new.commands:
        return ""
    pairs = itertools.zip_longest(old.commands, new.commands)
    before, now = next(pair for pair in pairs if pair[0] != pair[1])
    return f"'{before or 'nothing'}' is '{now or 'nothing'}' now"


def has_inputs(record: Record, inputs: Sequence[tuple[str, str]]) -> bool:
    """Tell whether a task was made from these contents; the folders may have moved as a whole."""

    def known(pairs: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
        return [(Path(folder).name, digest) for folder, digest in pairs]

    return known(record.inputs) == known(inputs)


def folder_hash(folder: Path) -> str:
    """Return the SHA-256 of the names and contents of all files below a folder.

    Hidden files, and the cards of maps, which have paths, do not count.

    Raises:
        UserError: A file cannot be read, or there is no such folder.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: is no folder")
    digest = hashlib.sha256()
    try:
        for path in sorted(folder.rglob("*")):
            inner = path.relative_to(folder)
            is_hidden = any(part.startswith(".") for part in inner.parts)
            if is_hidden or path.name == CARD_FILE or not path.is_file():
                continue
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").digest()
            digest.update(inner.as_posix().encode("utf-8", "surrogateescape") + b"\0" + content)
    except OSError as error:
        raise UserError(f"{error.filename or folder}: cannot be read ({error.strerror})") from error
    return digest.hexdigest()


def _given(text: str | None) -> str:
    return "not given" if text is None else text


@dataclasses.dataclass(frozen=True)
class Task:
    """Commands of a stage on map folders."""

    stage: Stage
    name: str  # unique in the stage; the result's folder is called so
    inputs: tuple[Path, ...]  # map folders that it reads
    lines: tuple[
        str, ...
    ]  # the commands with the inputs put in; `<RESULT_FOLDER>` is not replaced yet
    result: Path  # folder that it writes
    edits_input: bool  # the result is the map itself, which the commands save

    @property
    def title(self) -> str:
        """Stage and name."""
        return f"{self.stage.name}/{self.name}"

    @property
    def script(self) -> str:
        """The commands as a script; `<RESULT_FOLDER>` is not replaced yet."""
        return "".join(line + "\n" for line in self.lines)


def task_on(
    stage: Stage, name: str, inputs: Sequence[Path], results: Path, *, edits_input: bool
) -> Task:
    """Return the task of a stage on some maps; see `Task` and `Stage.commands`."""
    lines: list[str] = []
    for line in stage.commands:
        repeated = inputs if MAP_TEMPLATE in line else inputs[:1]
        lines += [line.replace(MAP_TEMPLATE, shlex.quote(str(folder))) for folder in repeated]
    result = inputs[0] if edits_input else results / stage.name / name
    return Task(stage, name, tuple(inputs), tuple(lines), result, edits_input)


def names_of(folders: Sequence[Path]) -> list[str]:
    """Return a short unique name per folder: its own, with as many parents as it takes.

    Raises:
        UserError: Two folders are the same.
    """
    for parts in range(1, 1 + max((len(folder.parts) for folder in folders), default=1)):
        names = ["-".join(folder.parts[-parts:]).strip("/") or "root" for folder in folders]
        if len(set(names)) == len(names):
            return names
    raise UserError("a map folder is given twice")
