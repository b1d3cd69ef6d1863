"""Scripts: files of console commands, and maplab's batch files that run them on many maps."""

from __future__ import annotations

import dataclasses
import glob
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maplab_py.console.flag_types import expand_path
from maplab_py.console.runner import Runner
from maplab_py.console.status import Status
from maplab_py.errors import UserError

FOLDER_TEMPLATE = "<CURRENT_VIMAP_FOLDER>"


def read_script(path: Path) -> str:
    """Read a file of commands.

    Raises:
        UserError: It is missing or not text.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from None


@dataclasses.dataclass(frozen=True)
class Batch:
    """A batch file: commands that are run once per map folder."""

    folders: tuple[str, ...]
    commands: tuple[str, ...]


def read_batch(path: Path) -> Batch:
    """Read a batch file with the keys `vi_map_folder_paths` and `commands`.

    Raises:
        UserError: The file is missing, no YAML, or lacks a key.
    """
    import yaml

    try:
        content = yaml.safe_load(read_script(path))
    except yaml.YAMLError as error:
        raise UserError(f"{path}: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: keys vi_map_folder_paths and commands are wanted")
    unknown = set(content) - {"vi_map_folder_paths", "commands"}
    if unknown:
        raise UserError(f"{path}: unknown key '{min(map(str, unknown))}'")
    folders = _strings(content, "vi_map_folder_paths", path)
    found = [folder for pattern in folders for folder in _matching(pattern, path)]
    return Batch(tuple(found), _strings(content, "commands", path))


def _matching(pattern: str, path: Path) -> list[str]:
    """Return the folders that an entry of the list means: itself, or what its wildcards match.

    Raises:
        UserError: A variable is not set, or the wildcards match nothing.
    """
    try:
        text = str(expand_path(pattern))
    except ValueError as error:
        raise UserError(f"{path}: vi_map_folder_paths: {error}") from None
    if not any(character in text for character in "*?["):
        return [text]
    folders = sorted(name for name in glob.glob(text) if Path(name).is_dir())
    if not folders:
        raise UserError(f"{path}: vi_map_folder_paths: no folder matches {pattern}")
    return folders


def run_batch(
    batch: Batch, make_runner: Callable[[], Runner], *, keep_going: bool, discard: bool
) -> Status:
    """Run a batch file's commands for each of its folders, each time in a fresh session.

    Args:
        batch: What to run.
        make_runner: Makes the runner of a fresh session.
        keep_going: Go on with the next command, and the next folder, after a failure.
        discard: Maps may be left unsaved.

    Returns:
        The status of the first failure.
    """
    first = Status.OK
    failed = 0
    for folder in batch.folders:
        runner = make_runner()
        runner.terminal.note(f"map folder {folder}")
        text = "\n".join(batch.commands).replace(FOLDER_TEMPLATE, _quoted(folder))
        status = runner.run_text(text, keep_going=keep_going)
        status = status or runner.finish(discard=discard)
        runner.session.watchers.close()
        failed += status != Status.OK
        first = first or status
        if status == Status.CANCELLED or (status and not keep_going):
            break
    if batch.folders:
        runner.terminal.note(f"{len(batch.folders)} map folders, {failed} failed")
    return first


def _quoted(folder: str) -> str:
    """Protect blanks and the like by backslashes, which work inside a word too."""
    return "".join(f"\\{c}" if c in " \t;#'\"\\" else c for c in folder)


def _strings(content: dict[str, Any], key: str, path: Path) -> tuple[str, ...]:
    if key not in content:
        raise UserError(f"{path}: key {key} is missing")
    values = content[key]
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise UserError(f"{path}: {key} is not a list of strings")
    return tuple(values)
