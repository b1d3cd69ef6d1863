"""Reading scenarios from YAML: every mistake is one line that names file and key."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from maplab_py.errors import MapError, UserError
from maplab_py.input_files import SCRIPT_MAX_BYTES, read_text
from maplab_py.sensors.yaml_text import parse_yaml
from maplab_py.simulation.limits import check_scenario
from maplab_py.simulation.reports import ScenarioLine, ScenarioList
from maplab_py.simulation.scenario import Scenario

_FOLDER = Path(__file__).parent / "scenarios"
_KINDS: dict[type, str] = {bool: "true or false", int: "a whole number", float: "a number"}


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the program."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def list_scenarios() -> ScenarioList:
    """Describe the scenarios that come with the program."""
    lines = []
    for name in scenario_names():
        scenario = load_scenario(name)
        seconds = sum(session.total_s for session in scenario.sessions)
        lines.append(ScenarioLine(name, len(scenario.sessions), seconds, scenario.description))
    return ScenarioList(tuple(lines))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Read a scenario by name, or from a YAML file.

    Raises:
        UserError: There is no such scenario, or it has a mistake; names file and key.
    """
    path = Path(name_or_path)
    if str(name_or_path) in scenario_names():
        path = _FOLDER / f"{name_or_path}.yaml"
    elif not path.is_file():
        known = ", ".join(scenario_names())
        raise UserError(
            f"there is no scenario '{name_or_path}': give a YAML file or one of {known}"
        )
    try:
        text = read_text(path, SCRIPT_MAX_BYTES, remedy="scenarios are shorter")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise UserError(f"cannot read {path}: {reason}") from None
    return _with_absolute_paths(parse_scenario(text, path.name), path.parent)


def parse_scenario(text: str, source: str) -> Scenario:
    """Read a scenario from YAML text.

    Args:
        text: The YAML document.
        source: Name of its origin for messages.

    Raises:
        UserError: The text has a mistake; names source and key.
    """
    try:
        content = parse_yaml(text, source)
    except MapError as error:
        raise UserError(_syntax_error(source, error)) from None
    try:
        scenario: Scenario = _read(Scenario, content, "")
        check_scenario(scenario)
    except UserError as error:
        raise UserError(f"{source}: {error}") from None
    return scenario


def _syntax_error(source: str, error: MapError) -> str:
    """Say in a few words where the text ceases to be YAML."""
    cause = error.__cause__
    problem = getattr(cause, "problem", None) or "it cannot be read"
    mark = getattr(cause, "problem_mark", None)
    where = f", line {mark.line + 1}" if mark else ""
    return f"{source}{where}: this is not YAML: {problem}"


def _with_absolute_paths(scenario: Scenario, folder: Path) -> Scenario:
    """Return the scenario with the files of its sessions looked up beside the scenario file."""

    def beside(file: str) -> str:
        return str(folder / file) if file else ""

    sessions = tuple(
        dataclasses.replace(
            session,
            trajectory=beside(session.trajectory),
            recorded_imu=beside(session.recorded_imu),
        )
        for session in scenario.sessions
    )
    return dataclasses.replace(scenario, sessions=sessions)


def _read(kind: Any, value: Any, key: str) -> Any:
    """Turn a YAML value into a dataclass, a tuple or a scalar."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _read_group(kind, value, key)
    if typing.get_origin(kind) is tuple:
        return _read_list(typing.get_args(kind), value, key)
    if isinstance(kind, types.UnionType):
        raise TypeError(f"{key}: unions are not supported")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is float and is_number:
        return float(value)
    if isinstance(value, kind) and (kind is bool or not isinstance(value, bool)):
        return value
    raise UserError(f"{key}: {_KINDS.get(kind, 'a text')} is expected, not {value!r}")


def _read_group(kind: type, value: Any, key: str) -> Any:
    if not isinstance(value, Mapping):
        raise UserError(f"{key or 'the file'}: a mapping of keys is expected, not {value!r}")
    hints = typing.get_type_hints(kind)
    fields: dict[str, Any] = {}
    for name, item in value.items():
        inner = f"{key}.{name}" if key else str(name)
        if name not in hints:
            near = difflib.get_close_matches(str(name), hints, 1)
            hint = f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(hints)}"
            raise UserError(f"{inner}: unknown key{hint}")
        fields[name] = _read(hints[name], item, inner)
    return kind(**fields)


def _read_list(kinds: tuple[Any, ...], value: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise UserError(f"{key}: a list is expected, not {value!r}")
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise UserError(f"{key}: {len(kinds)} values are expected, not {len(value)}")
    return tuple(
        _read(kind, item, f"{key}[{row}]")
        for row, (kind, item) in enumerate(zip(kinds, value, strict=True))
    )
