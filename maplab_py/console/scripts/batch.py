"""Scripts: files of console commands, and maplab's batch files that run them on many maps."""

import dataclasses
import glob
from collections.abc import Callable
from pathlib import Path
from typing import Any

from maplab_py.console.commands import flag_types, lines
from maplab_py.console.scripts.checking import check_commands
from maplab_py.console.scripts.runner import Runner
from maplab_py.console.session.status import Status
from maplab_py.errors import UserError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text
from maplab_py.pipeline.plan import MAP_TEMPLATE, Stage
from maplab_py.report import counted

FOLDER_TEMPLATE = MAP_TEMPLATE


def read_script(path: Path) -> str:
    """Read a file of commands.

    Raises:
        UserError: It is missing or not text.
    """
    try:
        return read_text(path, SCRIPT_MAX_BYTES, remedy="scripts are shorter")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"{path}: cannot be read: {reason}") from None


@dataclasses.dataclass(frozen=True)
class Batch:
    """A batch file: commands that are run once per map folder, or stages of a pipeline."""

    folders: tuple[str, ...]
    commands: tuple[str, ...]
    stages: tuple[Stage, ...] = ()


def read_batch(path: Path, maps_folder: Path | None = None) -> Batch:
    """Read a batch file with the keys `vi_map_folder_paths` and `commands` or `stages`.

    Args:
        maps_folder: Run on the maps in this folder and below it, not on those that the file lists.

    Raises:
        UserError: The file is missing, no YAML, or lacks a key; or the folder has no maps.
    """
    from maplab_py.sensors.yaml_text import parse_yaml

    content = parse_yaml(read_script(path), str(path))
    if not isinstance(content, dict):
        raise UserError(f"{path}: needs the keys vi_map_folder_paths and commands")
    unknown = set(content) - {"vi_map_folder_paths", "commands", "stages"}
    if unknown:
        raise UserError(f"{path}: unknown key '{min(map(str, unknown))}'")
    if "stages" in content and "commands" in content:
        raise UserError(f"{path}: give commands or stages, not both")
    stages = read_stages(content["stages"], path) if "stages" in content else ()
    commands = () if stages else _strings(content, "commands", path)
    if maps_folder is not None:
        return Batch(_maps_below(maps_folder), commands, stages)
    if "vi_map_folder_paths" not in content:
        raise UserError(f"{path}: key vi_map_folder_paths is missing (or give --maps_folder=...)")
    folders = _strings(content, "vi_map_folder_paths", path)
    matched = [folder for pattern in folders for folder in _matching(pattern, path)]
    return Batch(tuple(matched), commands, stages)


def _maps_below(folder: Path) -> tuple[str, ...]:
    from maplab_py.storage.native import find_maps

    folders = tuple(str(map_folder) for map_folder in find_maps(folder))
    if not folders:
        raise UserError(f"--maps_folder={folder}: there is no map in it or below it")
    return folders


def _matching(pattern: str, path: Path) -> list[str]:
    """Return the folders that an entry of the list means: itself, or what its wildcards match.

    Raises:
        UserError: A variable is not set, or the wildcards match nothing.
    """
    try:
        text = str(flag_types.expand_path(pattern))
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

    The commands for all folders are checked before the first one runs, unless `keep_going` is set.

    Args:
        batch: What to run.
        make_runner: Makes the runner of a fresh session.
        keep_going: Go on with the next command, and the next folder, after a failure.
        discard: Maps may be left unsaved.

    Returns:
        The status of the first failure.
    """
    commands = "\n".join(batch.commands)
    texts = [commands.replace(FOLDER_TEMPLATE, lines.escaped(folder)) for folder in batch.folders]
    if not keep_going:
        runner, written = make_runner(), list[Path]()
        checked = [check_commands(text, runner.session, written) for text in texts]
        if status := runner.report_problems(
            [
                f"map folder {folder}: {problem}"
                for folder, problems in zip(batch.folders, checked, strict=True)
                for problem in problems
            ]
        ):
            return status
    first = Status.OK
    failed = 0
    for folder, text in zip(batch.folders, texts, strict=True):
        runner = make_runner()
        runner.terminal.note(f"map folder {folder}")
        status = runner.run_checked(text, keep_going=keep_going)
        status = runner.finish(status, discard=discard)
        runner.session.watchers.close()
        failed += status != Status.OK
        first = first or status
        if status == Status.CANCELLED or (status and not keep_going):
            break
    if batch.folders:
        runner.terminal.note(f"{counted(len(batch.folders), 'map folder')}, {failed} failed")
    return first


def _strings(content: dict[str, Any], key: str, path: Path) -> tuple[str, ...]:
    if key not in content:
        raise UserError(f"{path}: key {key} is missing")
    values = content[key]
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise UserError(f"{path}: {key} is not a list of strings")
    return tuple(values)


_KEYS = {"name", "each", "all", "commands", "memory_gb"}


def read_stages(value: Any, path: Path) -> tuple[Stage, ...]:
    """Read the value of the key `stages`.

    Raises:
        UserError: It is no list of stages, or a stage has a wrong or unknown key.
    """
    if not isinstance(value, list) or not value:
        raise UserError(f"{path}: stages is not a list of stages")
    return tuple(_read_stage(entry, number, path) for number, entry in enumerate(value, start=1))


def _read_stage(entry: Any, number: int, path: Path) -> Stage:
    if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
        raise UserError(f"{path}: stage {number} has no name")
    name = entry["name"]
    if unknown := {str(key) for key in entry} - _KEYS:
        raise UserError(f"{path}: stage {name}: unknown key '{min(unknown)}'")
    each = entry.get("each", "")
    if not isinstance(each, str):
        raise UserError(f"{path}: stage {name}: 'each' is not the name of one stage")
    memory_gb = entry.get("memory_gb", 0.0)
    if isinstance(memory_gb, bool) or not isinstance(memory_gb, (int, float)):
        raise UserError(f"{path}: stage {name}: memory_gb is not a number")
    commands = _words(entry.get("commands", []), f"{path}: stage {name}: commands")
    sources = _words(entry.get("all", []), f"{path}: stage {name}: all")
    return Stage(name, commands, each, sources, float(memory_gb))


def _words(value: Any, place: str) -> tuple[str, ...]:
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list) or not all(isinstance(word, str) for word in values):
        raise UserError(f"{place} is not a list of strings")
    return tuple(values)
