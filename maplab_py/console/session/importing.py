"""Importers: functions that read files into a map, registered as commands."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from maplab_py.console.commands import command, flag_types
from maplab_py.console.commands.flags import Flag
from maplab_py.console.session.context import CommandContext
from maplab_py.console.session.maps import key_of_folder
from maplab_py.errors import UserError
from maplab_py.report import Report

if TYPE_CHECKING:
    from maplab_py.vimap import VIMap

_MAP_KEY = Flag(
    "map_key", flag_types.flag_type(str), "", "Name of the map in memory; empty = the path's name",
    path=("map_key",),
)  # fmt: skip

ReaderT = TypeVar("ReaderT", bound="Callable[..., VIMap]")


class ImportedMap(Report):
    """The map that was read."""

    map_key: str
    source: Path
    missions: int
    vertices: int
    landmarks: int
    observations: int


def importer(
    name: str, *aliases: str, example: str, see_also: tuple[str, ...] = ()
) -> Callable[[ReaderT], ReaderT]:
    """Register a function that reads files into a map as a command; the function is unchanged.

    Its first parameter is the path, which must exist; the others become flags as those of a
    command; one called `progress` receives the command's progress. The command has the flag
    --map_key too, adds the map under that key and selects it.

    Args:
        name: Name of the command, such as import_colmap.
        aliases: Short names.
        example: One line that can be typed as it is.
        see_also: Related commands for the help page.

    Raises:
        TypeError: The signature cannot be a command.
    """

    def decorate(function: ReaderT) -> ReaderT:
        described = command.describe(
            _command_of(function),
            name,
            aliases,
            example=example,
            see_also=see_also,
            needs_map=False,
        )
        if _MAP_KEY.name in described.flags:
            raise TypeError(f"command {name}: flag --{_MAP_KEY.name} is defined twice")
        flags = types.MappingProxyType({**described.flags, _MAP_KEY.name: _MAP_KEY})
        setattr(function, command.COMMAND_ATTRIBUTE, dataclasses.replace(described, flags=flags))
        return function

    return decorate


def _command_of(function: Callable[..., VIMap]) -> Callable[..., ImportedMap]:
    """Return the command's function, with the signature that its flags are read from."""
    parameters = list(inspect.signature(function).parameters.values())
    source, wants_progress = parameters[0].name, "progress" in {p.name for p in parameters}

    @functools.wraps(function)
    def run(context: CommandContext, *, map_key: str, **arguments: Any) -> ImportedMap:
        path: Path = arguments[source]
        if not path.exists():
            raise UserError(f"{path}: no such file or folder")
        default_key = key_of_folder(path if path.is_dir() else path.with_suffix(""))
        key = context.maps.check_new_key(map_key or default_key)
        progress = {"progress": context.progress} if wants_progress else {}
        vi_map = function(arguments.pop(source), **arguments, **progress)
        context.maps.add(key, vi_map)
        return ImportedMap(
            key, path, len(vi_map.missions), len(vi_map.vertices), len(vi_map.landmarks),
            len(vi_map.observations),
        )  # fmt: skip

    context = inspect.Parameter("context", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    flags = [p for p in parameters if p.name != "progress"]
    run.__signature__ = inspect.Signature([context, *flags])  # type: ignore[attr-defined]
    run.__annotations__ = command.parameter_hints(function, [p.name for p in flags])
    return run
