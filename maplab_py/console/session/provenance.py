"""Provenance of maps: the commands that led to a value, so that they can be written as a script.

Maps are values: undo, redo and restore return to a value whose commands are known. A command that
makes a new value follows the commands of the maps that it read.
"""

from __future__ import annotations

import dataclasses
import itertools
import weakref
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maplab_py.console.commands.flag_types import format_value
from maplab_py.console.commands.lines import escaped
from maplab_py.console.session.call import Call
from maplab_py.console.session.maps import MapEntry, MapsState

if TYPE_CHECKING:
    from maplab_py.console.session.cards import CardInput
    from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True)
class ScriptLine:
    """A command that changed maps."""

    number: int  # in the order of their ends
    text: str  # with every value that is not the default
    selected_before: str  # key of the map that the command worked on; empty = none
    selected_after: str
    inputs: tuple[CardInput, ...] = dataclasses.field(default=(), compare=False)
    outputs: tuple[str, ...] = dataclasses.field(default=(), compare=False)


Script = tuple[ScriptLine, ...]


class Provenance:
    """The commands that led to each value of the maps of a session."""

    def __init__(self) -> None:
        self._scripts: weakref.WeakKeyDictionary[VIMap, dict[str, Script]] = (
            weakref.WeakKeyDictionary()
        )
        self._numbers = itertools.count(1)

    def record(self, call: Call, base: MapsState, result: MapsState) -> None:
        """Record a finished command that led from one state of the maps to another."""
        new = [
            entry
            for key, entry in result.entries.items()
            if base.entries.get(key) is None or base.entries[key].vi_map is not entry.vi_map
        ]
        unknown = [entry for entry in new if entry.key not in self._scripts.get(entry.vi_map, {})]
        if not unknown:
            return
        before = base.selected if call.command.needs_map else ""
        from maplab_py.console.session.cards import input_of

        copies = [entry.disk_copy for entry in result.entries.values() if entry.disk_copy]
        known = {copy.folder: copy.fingerprint for copy in copies}
        read_paths, written_paths = _paths_of(call, base)
        inputs = tuple(input_of(path, known.get(path.resolve(), "")) for path in read_paths)
        outputs = tuple(str(path.absolute()) for path in written_paths)
        text, number = _text(call, base), next(self._numbers)
        line = ScriptLine(number, text, before, result.selected, inputs, outputs)
        named = {value for value in call.values.values() if isinstance(value, str)}
        removed = base.entries.keys() - result.entries.keys()
        read = {before} | named | removed | {entry.key for entry in unknown}
        lines = {
            known
            for key in read & base.entries.keys()
            for known in self.script_of(base.entries[key])
        }
        script = (*sorted(lines, key=lambda known: known.number), line)
        for entry in unknown:
            self._scripts.setdefault(entry.vi_map, {})[entry.key] = script

    def script_of(self, entry: MapEntry) -> Script:
        """Return the commands that led to the value of a map; none if they are not known."""
        scripts = self._scripts.get(entry.vi_map, {})
        if entry.key in scripts or not scripts:
            return scripts.get(entry.key, ())
        key, script = next(iter(scripts.items()))  # the map was renamed since
        line = ScriptLine(script[-1].number, f"rename_map {entry.key}", key, entry.key)
        return (*script, line)

    def write_cards(
        self,
        call: Call,
        base: MapsState,
        result: MapsState,
        accuracy_of: Callable[[MapEntry], str],
    ) -> list[str]:
        """Write the cards of the maps that a command has saved; return why some cannot be written."""
        problems = []
        read, written = ({path.resolve() for path in paths} for paths in _paths_of(call, base))
        known = {id(entry.disk_copy) for entry in base.entries.values()}
        for entry in result.entries.values():
            copy, script = entry.disk_copy, self.script_of(entry)
            if copy is None or not entry.is_saved or id(copy) in known or not script:
                continue
            inputs = tuple(dict.fromkeys(given for line in script for given in line.inputs))
            folders = copy.folder, *copy.folder.parents
            is_loaded = not read.isdisjoint(folders) and written.isdisjoint(folders)
            if is_loaded or not copy.fingerprint:
                continue
            from maplab_py.console.session.cards import write_card  # with the libraries of saving

            outputs = tuple(dict.fromkeys(path for line in script for path in line.outputs))
            try:
                write_card(entry, script_text(script), inputs, outputs, accuracy_of(entry))
            except (OSError, ValueError, RecursionError) as error:
                problems.append(f"{copy.folder}: the card cannot be written: {error}")
        return problems


def script_text(script: Script) -> list[str]:
    """Return the lines of a script; maps are selected where the next command needs that."""
    lines, selected = [], ""
    for line in script:
        if line.selected_before and line.selected_before != selected:
            lines.append(f"select_map {line.selected_before}")
        lines.append(line.text)
        selected = line.selected_after
    return lines


def _paths_of(call: Call, base: MapsState) -> tuple[list[Path], list[Path]]:
    """Return the paths that a call reads, and those that it writes."""
    reads = call.command.reads
    values = _values(call, base)
    paths = {name: path for name, path in values.items() if isinstance(path, Path)}
    written = [path for name, path in paths.items() if name not in reads]
    return [paths[name] for name in reads if name in paths], written


def _values(call: Call, base: MapsState) -> dict[str, Any]:
    """Return the values of a call; names of folders that are no keys of maps are paths."""
    values = dict(call.values)
    for name in call.command.reads:
        value = values.get(name)
        if isinstance(value, str) and value not in base.entries and Path(value).is_dir():
            values[name] = Path(value)
    return values


def _text(call: Call, base: MapsState) -> str:
    """Write a call as a line, with the lasting flags that it used."""
    flags = call.command.flags
    given: Mapping[str, Any] = {
        name: value for name, value in _values(call, base).items() if value != flags[name].default
    }
    words: Iterable[str] = (f"--{name}={_quote(value)}" for name, value in sorted(given.items()))
    return " ".join([call.command.name, *words, *map(_quote, call.words)])


def _quote(value: Any) -> str:
    """Return a value as a word; paths are absolute, so that the script runs in any folder."""
    text = format_value(value.absolute() if isinstance(value, Path) else value)
    return escaped(text).replace("$", "\\$") if text else "''"
