"""Help pages and the list of plugins."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from maplab_py.plugin import CommandContext, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class CommandLine:
    """One command in a list."""

    command: str
    aliases: str
    help: str


@dataclasses.dataclass(frozen=True)
class CommandIndex(Report):
    """Commands by plugin."""

    commands: Mapping[str, tuple[CommandLine, ...]]


@dataclasses.dataclass(frozen=True)
class FlagLine:
    """One flag in a help page."""

    flag: str
    type: str
    default: str
    unit: str
    help: str


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class PluginList(Report):
    """All plugins; those that failed to load with the reason."""

    plugins: tuple[PluginLine, ...]
    names_claimed_twice: tuple[str, ...]


@command("help", "h", "?", example="help optvi", needs_map=False)
def show_help(
    context: CommandContext,
    command_name: str = "",
    *,
    plugin: str = "",
    all_: bool = False,
    command_filter: str = "",
) -> CommandIndex | CommandPage | CommandPages:
    """List the commands, or explain one.

    Args:
        command_name: Command or alias to explain; empty lists the commands.
        plugin: List only the commands of this plugin.
        all_: Explain every command that is listed.
        command_filter: List only commands whose name, alias or help contains this text.
    """
    if command_name:
        return _page(context, command_name)
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
    return CommandIndex(groups)


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
