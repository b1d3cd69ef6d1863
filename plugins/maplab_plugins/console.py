"""The console's own commands: help, plugins, lasting flags, timing, repetition, transcript."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path

from maplab_py.plugin import Cancelled, CommandContext, Message, Report, UserError, command


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
    flags: tuple[FlagLine, ...]


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
    """All plugins, the broken ones with the reason."""

    plugins: tuple[PluginLine, ...]
    names_claimed_twice: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class SettingLine:
    """The value of one flag and where it comes from."""

    flag: str
    value: str
    origin: str
    commands: str


@dataclasses.dataclass(frozen=True)
class SettingList(Report):
    """Flags with their values."""

    flags: tuple[SettingLine, ...]


@dataclasses.dataclass(frozen=True)
class TimingLine:
    """The runs of one command."""

    command: str
    runs: int
    total_s: float
    mean_s: float
    longest_s: float


@dataclasses.dataclass(frozen=True)
class TimingTable(Report):
    """Time spent in commands in this session, most expensive first."""

    timings: tuple[TimingLine, ...]


@command("help", "h", "?", example="help optvi", needs_map=False)
def show_help(
    context: CommandContext,
    command_name: str = "",
    *,
    plugin: str = "",
    all_: bool = False,
    command_filter: str = "",
) -> Report:
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
    found = registry.find(name)
    words = [f"<{name}>" for name in found.positional if found.flags[name].is_required]
    words += [f"[{name}]" for name in found.positional if not found.flags[name].is_required]
    words += ["..."] if found.variadic else []
    required = [
        f"--{name}=..."
        for name, flag in found.flags.items()
        if flag.is_required and name not in found.positional
    ]
    flags = ["[--FLAG=VALUE ...]"] if found.flags else []
    lines = tuple(
        FlagLine(f"--{flag.name}", flag.type.text, flag.default_text, flag.unit, flag.help)
        for flag in found.flags.values()
    )
    return CommandPage(
        found.name,
        found.summary,
        found.description,
        ", ".join(found.aliases),
        registry.owner(found),
        " ".join([found.name, *words, *required, *flags]),
        found.example,
        ", ".join(found.see_also),
        lines,
    )


@command("plugins", needs_map=False)
def list_plugins(context: CommandContext) -> PluginList:
    """List the plugins with their versions, and the broken ones with the reason."""
    registry = context.session.registry
    lines = tuple(
        PluginLine(p.name, p.version, len(p.commands), p.module, p.error) for p in registry.plugins
    )
    clashes = tuple(clash for p in registry.plugins for clash in p.clashes)
    return PluginList(lines, clashes)


@command(
    "set",
    example="set --ba_num_iterations=20",
    see_also=("unset", "flags"),
    needs_map=False,
    raw_arguments=True,
)
def set_flags(context: CommandContext, *assignments: str) -> Report:
    """Give flags values that last for the session; without arguments list them.

    Args:
        assignments: --name=value, name=value, --name or --noname, any number of them.
    """
    if not assignments:
        return list_flags(context)
    given = context.session.set_flags(assignments)
    return Message("\n".join(f"--{setting.name}={setting.text}" for setting in given))


@command("unset", example="unset ba_num_iterations", needs_map=False, raw_arguments=True)
def unset_flags(context: CommandContext, *names: str) -> Message:
    """Take back what `set` or --keep_gflags gave to flags.

    Args:
        names: Names of flags.
    """
    if not names:
        raise UserError("unset: name the flags to take back (see: flags)")
    for name in names:
        if context.session.settings.unset(name) is None:
            raise UserError(f"unset: --{name.lstrip('-')} has not been set")
    return Message("")


@command("flags", example="flags ba_", needs_map=False)
def list_flags(context: CommandContext, filter_: str = "") -> Report:
    """Show the values of flags and where they come from.

    Without a filter only those that differ from the default are shown.

    Args:
        filter_: Show all flags whose name contains this text.
    """
    registry, current = context.session.registry, context.session.settings.current()
    wanted = filter_.lstrip("-").replace("-", "_")
    names = [n for n in registry.all_flags() if wanted in n] if wanted else list(current)
    lines = []
    for name in sorted(names):
        owners = registry.flags_named(name)
        setting = current.get(name)
        value = setting.text if setting else owners[0][1].default_text
        origin = setting.origin if setting else "default"
        lines.append(SettingLine(f"--{name}", value, origin, _names(c.name for c, _ in owners)))
    if not lines:
        return Message("no such flag" if wanted else "all flags have their defaults")
    return SettingList(tuple(lines))


def _names(names: Iterable[str], shown: int = 4) -> str:
    listed = list(names)
    more = f" and {len(listed) - shown} more" if len(listed) > shown else ""
    return ", ".join(listed[:shown]) + more


@command("timing", needs_map=False)
def show_timing(context: CommandContext) -> Report:
    """Show how long the commands of this session took."""
    seconds: dict[str, list[float]] = {}
    for timing in context.session.timings:
        seconds.setdefault(timing.command, []).append(timing.seconds)
    lines = [
        TimingLine(name, len(runs), sum(runs), sum(runs) / len(runs), max(runs))
        for name, runs in seconds.items()
    ]
    if not lines:
        return Message("no command has run yet")
    return TimingTable(tuple(sorted(lines, key=lambda line: -line.total_s)))


@command("watch", "w", example='watch --command="map_stats" --every=5', needs_map=False)
def watch(
    context: CommandContext, command: str, *, every: float = 2.0, repetitions: int = 0
) -> Message:
    """Repeat a command until Ctrl-C.

    Args:
        command: The command with its flags, in quotes.
        every: Pause between two runs in seconds.
        repetitions: Stop after so many runs; 0 = only at Ctrl-C.
    """
    if not command.strip():
        raise UserError("watch: --command is empty; say what to repeat")
    if every < 0 or repetitions < 0:
        raise UserError("watch: --every and --repetitions cannot be negative")
    runs = 0
    try:
        while not repetitions or runs < repetitions:
            if runs:
                _sleep(context, every)
            context.session.run_line(command, context.terminal)
            runs += 1
    except Cancelled:
        return Message(f"stopped after {runs} runs")
    return Message(f"{runs} runs")


def _sleep(context: CommandContext, seconds: float) -> None:
    """Wait, but notice Ctrl-C at once."""
    import time

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        context.progress.check()
        time.sleep(min(0.05, max(0.0, end - time.monotonic())))
    context.progress.check()


@command("transcript", example="transcript session.txt", needs_map=False)
def transcript(context: CommandContext, file: Path | None = None) -> Message:
    """Copy everything that is typed and printed from now on to a file.

    Args:
        file: File to append to; without one the copying ends.
    """
    context.terminal.transcribe(file)
    return Message(f"transcript goes to {file}" if file else "transcript ended")


@command("enable_sheep", "sheep", needs_map=False)
def enable_sheep(context: CommandContext) -> Message:
    """Put a sheep into the prompt; once more to let it go."""
    context.session.prompt_sign = "" if context.session.prompt_sign else "\N{SHEEP}"
    return Message("baa")
