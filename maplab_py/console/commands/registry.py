"""The registry of commands: plugins from entry points, and the owners of names."""

import dataclasses
import functools
import logging
import os
import re
import threading
from collections.abc import Iterable, Mapping
from importlib.metadata import Distribution, EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from maplab_py.console.commands.command import COMMAND_ATTRIBUTE, Command
from maplab_py.console.commands.flag_index import Flags, Index, kept_index
from maplab_py.console.commands.flags import CONSOLE_FLAGS, Flag
from maplab_py.console.commands.suggest import unknown
from maplab_py.errors import FlagError, UserError
from maplab_py.memory import collection_paused

ENTRY_POINT_GROUP = "maplab_py.plugins"
PLUGINS_VARIABLE = "MAPLAB_PLUGINS"
ALWAYS_LOADED = "console"
BUILT_IN = "maplab_plugins."
_DECLARATION = re.compile(
    r'^(?:@command\(\s*((?:"[^"\s]+"[,\s]*)+)|(\w+) = \w+\(\s*"\2")', re.MULTILINE
)
"""A decorator with the names of a command, or a command that is made under the name of its variable."""

logger = logging.getLogger(__name__)


@dataclasses.dataclass
class Plugin:
    """An installed plugin."""

    name: str
    module: str = ""
    version: str = ""
    commands: list[Command] = dataclasses.field(default_factory=list)
    error: str = ""  # why it could not be loaded
    clashes: list[str] = dataclasses.field(default_factory=list)  # names that others had first


class Registry:
    """Commands by name and alias, with the plugins that own them.

    A built-in plugin is imported when one of its commands is looked for, others at once: they may bring
    residuals, layers and importers, too. What concerns all commands imports all plugins.
    """

    def __init__(self, entries: Iterable[EntryPoint] = ()) -> None:
        """Make a registry.

        Args:
            entries: Plugins to load when they are needed; of two with a command of the same name, the
                first keeps it.
        """
        self._plugins: list[Plugin] = []
        self._commands: dict[str, Command] = {}
        self._owners: dict[str, Plugin] = {}
        self._pending = {entry.name: entry for entry in entries}
        self._order = {name: index for index, name in enumerate(self._pending)}
        self._declared = {
            name: entry for entry in self._pending.values() for name in _declared_names(entry)
        }
        self._lock = threading.RLock()
        self._built_in = {n for n, e in self._pending.items() if e.value.startswith(BUILT_IN)}
        for entry in list(self._pending.values()):
            if entry.name not in self._built_in:
                self._load(entry)

    @property
    def plugins(self) -> list[Plugin]:
        """All plugins."""
        self._load_all()
        return self._plugins

    @property
    def commands(self) -> list[Command]:
        """All commands, by name, each once."""
        self._load_all()
        unique = {command.name: command for command in self._commands.values()}
        return [unique[name] for name in sorted(unique)]

    @property
    def names(self) -> list[str]:
        """All names and aliases."""
        self._load_all()
        return sorted(self._commands)

    @property
    def problems(self) -> list[str]:
        """One line for every broken plugin and every name that two plugins claim."""
        lines = [f"plugin {p.name} is not available: {p.error}" for p in self.plugins if p.error]
        return lines + [clash for plugin in self.plugins for clash in plugin.clashes]

    def find(self, name: str) -> Command:
        """Return the command with this name or alias.

        Raises:
            UserError: There is none; the message suggests similar names.
        """
        if self.knows(name):
            return self._commands.get(name) or self._commands[name.replace("-", "_")]
        broken = [plugin.name for plugin in self._plugins if plugin.error]
        hint = f"plugins not available: {', '.join(broken)} (see: plugins)" if broken else ""
        raise unknown("command", name, {*self._commands, *self._declared}, hint or "see: help")

    def knows(self, name: str) -> bool:
        """Tell whether a command has this name or alias."""
        return any(self._provide(spelling) for spelling in (name, name.replace("-", "_")))

    def owner(self, command: Command) -> str:
        """Return the name of the plugin that brought a command."""
        return self._owners[command.name].name

    def is_built_in(self, command: Command) -> bool:
        """Tell whether a command belongs to this distribution."""
        return self._owners[command.name].module.startswith(BUILT_IN)

    def flags_named(self, name: str) -> list[tuple[Command, Flag]]:
        """Return every command that has a flag of this name, with the flag."""
        for plugin in self._flag_index.get(name, ()):
            if plugin in self._pending:
                self._load(self._pending[plugin])
        owners = {c.name: c for c in self._commands.values() if name in c.flags}
        return [(owners[key], owners[key].flags[name]) for key in sorted(owners)]

    def all_flags(self) -> Mapping[str, Flag]:
        """Return one flag for every flag name of any command, and the console's own flags."""
        commands = [self._commands[name] for name in sorted(self._commands)]
        loaded = {name: flag for command in commands for name, flag in command.flags.items()}
        if not self._pending:
            return CONSOLE_FLAGS | loaded
        return Flags({*self._flag_index, *loaded}, self._flag)

    def _flag(self, name: str) -> Flag:
        named = self.flags_named(name)
        if not named:
            raise FlagError(f"--{name}: the plugin of its commands is not available (see: plugins)")
        return named[-1][1]

    @functools.cached_property
    def _flag_index(self) -> Index:
        """Names of the built-in plugins of every flag; they are imported only where no index is kept."""
        return kept_index([n for n in self._order if n in self._built_in], self._make_index)

    def _make_index(self) -> tuple[Index, bool]:
        index: dict[str, list[str]] = {}
        plugins = [plugin for plugin in self.plugins if plugin.name in self._built_in]
        for plugin in plugins:
            for name in {name: None for c in plugin.commands for name in c.flags}:
                index.setdefault(name, []).append(plugin.name)
        return index, not any(plugin.error for plugin in plugins)

    def add(self, command: Command, plugin: Plugin) -> None:
        """Register a command; a name that is in use stays with its first owner."""
        if self._provide(command.name):
            plugin.clashes.append(self._clash(command.name, plugin))
            return
        plugin.commands.append(command)
        self._owners[command.name] = plugin
        for name in command.names:
            if self._provide(name):
                plugin.clashes.append(self._clash(name, plugin))
            else:
                self._commands[name] = command

    def add_module(self, module: ModuleType, plugin: Plugin) -> None:
        """Register the commands that a module defines, not those it imports from elsewhere.

        Of a package they are those of its `__init__`, and of the modules that its `__all__` names.
        """
        for name, value in list(vars(module).items()):
            command = getattr(value, COMMAND_ATTRIBUTE, None)
            if isinstance(value, ModuleType) and name in getattr(module, "__all__", ()):
                self.add_module(value, plugin)
            elif isinstance(command, Command) and not isinstance(value, type):
                home = command.function.__module__
                if home == module.__name__ or home.startswith(module.__name__ + "."):
                    self.add(command, plugin)

    def _provide(self, name: str) -> bool:
        """Load the built-in plugin that declares a name, if any; return whether the name is in use."""
        if name not in self._commands and name in self._declared:
            self._load(self._declared[name])
        return name in self._commands

    def _load_all(self) -> None:
        for entry in list(self._pending.values()):
            self._load(entry)
        self._plugins.sort(key=lambda plugin: self._order.get(plugin.name, len(self._order)))

    def _load(self, entry: EntryPoint) -> None:
        """Load one plugin; if it fails it is listed with the reason, the traceback in the log."""
        with self._lock, collection_paused():
            if self._pending.pop(entry.name, None) is None:
                return
            version = _version(entry.dist) if entry.dist is not None else ""
            plugin = Plugin(entry.name, entry.value, version)
            self._plugins.append(plugin)
            try:
                loaded = entry.load()
            except (Exception, SystemExit) as error:
                plugin.error = f"{type(error).__name__}: {error}".splitlines()[0]
                logger.exception("plugin %s (%s) cannot be loaded", entry.name, entry.value)
                return
            if not isinstance(loaded, ModuleType):
                plugin.error = f"entry point '{entry.value}' is not a module"
                return
            self.add_module(loaded, plugin)
            for clash in plugin.clashes:
                logger.warning("%s", clash)

    def _clash(self, name: str, plugin: Plugin) -> str:
        first = self.owner(self._commands[name])
        return (
            f"command '{name}' of plugin {plugin.name} is taken by plugin {first}, which keeps it"
        )


def load_registry(entries: Iterable[EntryPoint] | None = None) -> Registry:
    """Return the installed plugins, which are loaded when they are needed.

    The environment variable MAPLAB_PLUGINS (names separated by commas) restricts which; the
    console's own commands are always there.

    Raises:
        UserError: The variable names a plugin that is not installed.
    """
    installed = sorted(entries or entry_points(group=ENTRY_POINT_GROUP), key=_loading_order)
    wanted = os.environ.get(PLUGINS_VARIABLE, "").replace(";", ",").split(",")
    names = {name.strip() for name in wanted if name.strip()}
    missing = names - {entry.name for entry in installed}
    if missing:
        raise UserError(
            f"{PLUGINS_VARIABLE} names plugins that are not installed: {', '.join(sorted(missing))}"
        )
    chosen = (e for e in installed if not names or e.name in names or e.name == ALWAYS_LOADED)
    return Registry(chosen)


def _declared_names(entry: EntryPoint) -> list[str]:
    """Return the names and aliases that the source of a built-in plugin declares, without importing it."""
    spec = find_spec(entry.value) if entry.value.startswith(BUILT_IN) else None
    if spec is None or spec.origin is None:
        return []
    origin = Path(spec.origin)
    is_package = spec.submodule_search_locations is not None
    names: list[str] = []
    for path in sorted(origin.parent.rglob("*.py")) if is_package else [origin]:
        for match in _DECLARATION.finditer(path.read_text()):
            names += re.findall(r'"([^"]+)"', match[1]) if match[1] else [match[2]]
    return names


@functools.cache
def _version(distribution: Distribution) -> str:
    """Return the version of a distribution; its metadata are parsed for each request."""
    return distribution.version


def _loading_order(entry: EntryPoint) -> tuple[bool, bool, str]:
    """Built-in plugins come first, so that a third-party plugin cannot take over a command."""
    is_built_in = entry.value.startswith(BUILT_IN)
    return entry.name != ALWAYS_LOADED, not is_built_in, entry.name
