"""Help: commands, plugins, and the schemas of reports."""

import dataclasses
import json
import re
from collections.abc import Mapping
from typing import Any

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag
from maplab_py.plugin import CommandContext, Report, UserError, command

_MAX_MATCHES = 12
_MAX_FLAGS = 2


@dataclasses.dataclass(frozen=True)
class CommandLine:
    """One command in a list."""

    command: str
    aliases: str
    help: str


@dataclasses.dataclass(frozen=True)
class TaskLine:
    """A task of a user with the commands for it."""

    task: str
    commands: str


TASKS = (
    TaskLine("check a recording, make a map of it", "check_recording, rovioli"),
    TaskLine("open maps, join sessions", "load, load_merge_all_maps, anchor_all_missions"),
    TaskLine("make it accurate", "optvi, relax, lc"),
    TaskLine("see it", "visualize, map_stats, plot_trajectory, why"),
    TaskLine("compare it with ground truth", "evaluate_trajectory"),
    TaskLine("make it small", "kfh, landmark_sparsify, split_map"),
    TaskLine("localise in it", "create_localization_summary_map, localize"),
    TaskLine("calibrate the sensors", "self_calibrate, import_calibration"),
    TaskLine("depth and surfaces", "stereo_dense_reconstruction, tsdf, create_mesh_from_tsdf_grid"),
    TaskLine("save it, hand it on", "save, export_trajectory_to_csv, export_bag, export_colmap"),
)


class CommandIndex(Report):
    """Common tasks, and commands by plugin."""

    tasks: tuple[TaskLine, ...]
    commands: Mapping[str, tuple[CommandLine, ...]]


@dataclasses.dataclass(frozen=True)
class MatchLine:
    """A command that has something to do with the words of a search."""

    command: str
    flags: str
    help: str


class MatchingCommands(Report):
    """Commands whose names, flags or help have the words of a search; the best first."""

    commands: tuple[MatchLine, ...]


@dataclasses.dataclass(frozen=True)
class FlagLine:
    """One flag in a help page."""

    flag: str
    type: str
    default: str
    unit: str
    help: str


class CommandPage(Report):
    """The help page of one command."""

    command: str
    summary: str
    description: str
    aliases: str
    plugin: str
    usage: str
    example: str
    see_also: str
    flags: tuple[FlagLine, ...] = dataclasses.field(metadata={"are_entries": True})


class CommandPages(Report):
    """The help pages of several commands, each with its one-line usage."""

    pages: tuple[CommandPage, ...]


@dataclasses.dataclass(frozen=True)
class PluginLine:
    """One plugin in a list."""

    plugin: str
    version: str
    commands: int
    module: str
    problem: str


class PluginList(Report):
    """All plugins; those that failed to load with the reason."""

    plugins: tuple[PluginLine, ...]
    names_claimed_twice: tuple[str, ...]


@command("help", "h", "?", "apropos", example="help optvi", needs_map=False)
def show_help(
    context: CommandContext,
    command_name: str = "",
    *words: str,
    plugin: str = "",
    all_: bool = False,
    command_filter: str = "",
) -> CommandIndex | CommandPage | CommandPages | MatchingCommands:
    """List common tasks and the commands, explain one command, or search for words.

    Words that are no command are searched in names, flags and help of all commands.

    Args:
        command_name: Command or alias to explain, or a word to search for; empty lists the commands.
        words: Further words to search for.
        plugin: List only the commands of this plugin.
        all_: Explain every command that is listed.
        command_filter: List only commands whose name, alias or help contains this text.
    """
    if command_name:
        return _explain(context, (command_name, *words))
    registry = context.session.registry
    plugins = {p.name: p for p in registry.plugins}
    if plugin and plugin not in plugins:
        raise UserError(f"help: no plugin is called '{plugin}' (see: plugins)")
    chosen = [plugins[plugin]] if plugin else registry.plugins
    wanted = command_filter.lower()
    groups = {
        p.name: tuple(
            CommandLine(c.name, ", ".join(c.aliases), c.summary)
            for c in sorted(p.commands, key=lambda c: c.name)
            if wanted in " ".join((*c.names, c.summary)).lower()
        )
        for p in chosen
    }
    groups = {name: lines for name, lines in groups.items() if lines}
    if not groups:
        raise UserError(f"help: no command matches '{command_filter or plugin}'")
    if all_:
        pages = [_page(context, line.command) for lines in groups.values() for line in lines]
        return CommandPages(tuple(pages))
    return CommandIndex(() if plugin or wanted else TASKS, groups)


def _explain(context: CommandContext, words: tuple[str, ...]) -> CommandPage | MatchingCommands:
    """Return the page of a command, or the commands that have to do with the words."""
    registry = context.session.registry
    if len(words) == 1 and registry.knows(words[0]):
        return _page(context, words[0])
    wanted = " ".join(words).lower().split()
    scores = {c.name: sum(_match(c, w) for w in wanted) for c in registry.commands}
    matching = [
        c for c in registry.commands if scores[c.name] and all(_match(c, w) for w in wanted)
    ]
    if not matching:
        if len(words) == 1:
            registry.find(words[0])  # it names similar commands, or where to look
        raise UserError(f"help: no command has to do with '{' '.join(words)}' (see: help)")
    best = sorted(matching, key=lambda c: (-scores[c.name], c.name))[:_MAX_MATCHES]
    return MatchingCommands(tuple(_match_line(c, wanted) for c in best))


def _match(described: Command, word: str) -> int:
    """Return how much a command has to do with a word: 8 by its name, down to 1 by its flags' help.

    A word that is a choice of a flag, such as the name of a format, counts as much as a part of the name.
    """
    choices = (flag.type.text.lower().split("|") for flag in described.flags.values())
    places = (
        (8, word in (name.lower() for name in described.names)),
        (5, any(_has(name, word) for name in described.names) or any(word in c for c in choices)),
        (4, _has(described.summary, word)),
        (2, _has(described.description, word) or any(_has(n, word) for n in described.flags)),
        (1, any(_has(_help_of(flag), word) for flag in described.flags.values())),
    )
    return max(weight for weight, is_there in (*places, (0, True)) if is_there)


def _has(text: str, word: str) -> bool:
    """Tell whether a word of the text begins with this one; `_` and `-` part words, too."""
    return re.search(rf"(?<![^\W_]){re.escape(word)}", text.lower()) is not None


def _help_of(flag: Flag) -> str:
    return f"{flag.name} {flag.help} {flag.type.text}"


def _match_line(described: Command, wanted: list[str]) -> MatchLine:
    flags = [
        f"--{flag.name}"
        for flag in described.flags.values()
        if any(_has(_help_of(flag), word) for word in wanted)
    ]
    more = [f"and {len(flags) - _MAX_FLAGS} more"] if len(flags) > _MAX_FLAGS else []
    return MatchLine(described.name, ", ".join(flags[:_MAX_FLAGS] + more), described.summary)


def _page(context: CommandContext, name: str) -> CommandPage:
    registry = context.session.registry
    described = registry.find(name)
    words = [f"<{name}>" for name in described.positional if described.flags[name].is_required]
    words += [f"[{name}]" for name in described.positional if not described.flags[name].is_required]
    words += ["..."] if described.variadic else []
    required = [
        f"--{name}=..."
        for name, flag in described.flags.items()
        if flag.is_required and name not in described.positional
    ]
    flags = ["[--FLAG=VALUE ...]"] if described.flags else []
    lines = tuple(
        FlagLine(f"--{flag.name}", flag.type.text, flag.default_text, flag.unit, flag.help)
        for flag in described.flags.values()
    )
    return CommandPage(
        described.name,
        described.summary,
        described.description,
        ", ".join(described.aliases),
        registry.owner(described),
        " ".join([described.name, *words, *required, *flags]),
        described.example,
        ", ".join(described.see_also),
        lines,
    )


@command("plugins", needs_map=False)
def list_plugins(context: CommandContext) -> PluginList:
    """List the plugins with their versions; those that failed to load with the reason."""
    registry = context.session.registry
    lines = tuple(
        PluginLine(p.name, p.version, len(p.commands), p.module, p.error) for p in registry.plugins
    )
    clashes = tuple(clash for p in registry.plugins for clash in p.clashes)
    return PluginList(lines, clashes)


class SchemaReport(Report):
    """A JSON schema."""

    json_schema: dict[str, Any]

    def as_text(self) -> str:
        """Return it as indented JSON."""
        return json.dumps(self.json_schema, indent=2)


@command("schema", example="schema map_stats", see_also=("help",), needs_map=False)
def show_schema(context: CommandContext, command_name: str = "") -> SchemaReport:
    """Show the JSON schema of what --json prints for one command, or for all.

    Every line is an object with the fields schema (the version, a number), command, status (0 done,
    1 failed, 2 wrong usage, 130 cancelled), error, seconds and report.

    Args:
        command_name: Command or alias; empty = all commands.
    """
    from maplab_py.console.commands.schema import line_schema

    registry = context.session.registry
    commands = [registry.find(command_name)] if command_name else registry.commands
    return SchemaReport(line_schema(commands))
