"""Flag values that last longer than one command, in layers, with their origins."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from typing import Any

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import (
    CONSOLE_FLAGS,
    normalise,
    parse_words,
    read_flagfile,
    resolve_name,
)
from maplab_py.console.commands.registry import Registry
from maplab_py.errors import FlagError


class Layer(IntEnum):
    """Origin of a lasting value; a higher layer takes precedence."""

    USER_CONFIG = 1
    START_UP = 2
    SET = 3


@dataclasses.dataclass(frozen=True)
class Setting:
    """Text of a flag with its origin."""

    name: str
    text: str
    origin: str


class Settings:
    """The lasting flag values of a session."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self._layers: dict[Layer, dict[str, Setting]] = {layer: {} for layer in Layer}

    def copy(self) -> Settings:
        """Return settings of the same values that change independently."""
        result = Settings(self._registry)
        result._layers = {layer: dict(settings) for layer, settings in self._layers.items()}
        return result

    def current(self) -> dict[str, Setting]:
        """Return the winning setting of every flag that has one."""
        merged: dict[str, Setting] = {}
        for layer in sorted(self._layers):
            merged.update(self._layers[layer])
        return merged

    def is_on(self, name: str) -> bool:
        """Return the value of one of the console's own switches."""
        return bool(self.value(name))

    def value(self, name: str) -> Any:
        """Return the value of one of the console's own flags."""
        flag, setting = CONSOLE_FLAGS[name], self.current().get(name)
        return flag.default if setting is None else flag.convert(setting.text)

    def for_command(self, command: Command) -> dict[str, Setting]:
        """Return the settings of a command's flags."""
        return {n: setting for n, setting in self.current().items() if n in command.flags}

    def assign(self, words: Sequence[str], layer: Layer, origin: str) -> list[Setting]:
        """Set lasting values of flags, all or none of them.

        Args:
            words: `--name=value`, `--name value`, `name=value`, `--name`, `--noname`.
            layer: Layer to set.
            origin: Origin that `flags` shows.

        Raises:
            FlagError: A flag is unknown or no command with this flag takes the value.
        """
        if not words:
            return []
        known = self._registry.all_flags()
        dashed = [w if w.startswith("-") or "=" not in w else f"--{w}" for w in words]
        given, plain = parse_words(dashed, known, "")
        if plain:
            raise FlagError(f"'{plain[0]}' is not a flag (write --name=value)")
        settings = [Setting(g.name, g.text, origin) for g in given if g.name in known]
        if len(settings) != len(given):
            refused = next(g.name for g in given if g.name not in known)
            raise FlagError(f"--{refused} cannot have a lasting value")
        for setting in settings:
            self._check(setting)
        self._layers[layer].update({setting.name: setting for setting in settings})
        return settings

    def assign_file(self, path: Path, layer: Layer) -> None:
        """Set the flags of a flag file as lasting values.

        Raises:
            FlagError: The file cannot be read, or a line of it is not a known flag.
        """
        for line in read_flagfile(path):
            try:
                self.assign(line.words, layer, line.origin)
            except FlagError as error:
                raise FlagError(f"{line.origin}: {error}") from None

    def keep(self, command: Command, texts: dict[str, str]) -> None:
        """Keep the flags of a finished command (`--keep_gflags`)."""
        origin = f"kept from {command.name}"
        self._layers[Layer.SET].update({n: Setting(n, t, origin) for n, t in texts.items()})

    def unset(self, name: str) -> Setting | None:
        """Remove the value that `set` or `--keep_gflags` gave a flag; None if there is none.

        Raises:
            FlagError: No command has such a flag.
        """
        flag, _ = resolve_name(normalise(name.lstrip("-")), self._registry.all_flags(), "")
        return self._layers[Layer.SET].pop(flag, None)

    def _check(self, setting: Setting) -> None:
        refusals = []
        flags = [flag for _, flag in self._registry.flags_named(setting.name)]
        flags += [flag for name, flag in CONSOLE_FLAGS.items() if name == setting.name]
        for flag in flags:
            try:
                flag.convert(setting.text)
            except FlagError as error:
                refusals.append(error)
            else:
                return
        raise refusals[0]
