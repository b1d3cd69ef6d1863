"""Aliases and lasting flags."""

import dataclasses
from collections.abc import Iterable

from maplab_py.plugin import CommandContext, Message, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class AliasLine:
    """One alias."""

    alias: str
    stands_for: str


class AliasList(Report):
    """The aliases of the session."""

    aliases: tuple[AliasLine, ...]


@command(
    "alias",
    example="alias tidy='elq; rbl'",
    see_also=("unalias",),
    needs_map=False,
    acts_outside=True,
)
def alias(
    context: CommandContext, definition: str = "", *, keep: bool = False
) -> AliasList | Message:
    """Give a command line a short name; without arguments list the aliases.

    The line may be several commands. Words behind the alias are put behind its line.

    Args:
        definition: NAME='COMMANDS', quoted if it contains blanks.
        keep: Also store it for later sessions.
    """
    from maplab_py.console.scripts.aliases import check_name

    aliases = context.session.aliases
    if not definition:
        lines = tuple(AliasLine(name, text) for name, text in sorted(aliases.items()))
        return AliasList(lines) if lines else Message("no aliases (write alias NAME='COMMANDS')")
    name, equals, text = definition.partition("=")
    if not equals or not text.strip():
        raise UserError(f"alias: '{definition}' is not NAME='COMMANDS'")
    check_name(name, context.session.registry)
    aliases[name] = text.strip()
    if keep:
        _keep(name, text.strip())
    return Message(f"{name} stands for: {text.strip()}")


@command(
    "unalias",
    example="unalias tidy",
    see_also=("alias",),
    needs_map=False,
    acts_outside=True,
    completes={"name": "alias"},
)
def unalias(context: CommandContext, name: str) -> Message:
    """Remove an alias, also for later sessions.

    Args:
        name: The alias.
    """
    aliases = context.session.aliases
    if name not in aliases:
        raise UserError(f"unalias: no alias '{name}' (there are: {', '.join(aliases) or 'none'})")
    del aliases[name]
    _keep(name, None)
    return Message(f"removed alias '{name}'")


def _keep(name: str, text: str | None) -> None:
    """Write an alias to the user's file, or remove it from there."""
    from maplab_py.console.scripts.aliases import read_aliases, write_aliases
    from maplab_py.console.session.paths import user_aliases

    kept = read_aliases(user_aliases())
    if text is not None:
        kept[name] = text
    elif kept.pop(name, None) is None:
        return
    write_aliases(user_aliases(), kept)


@dataclasses.dataclass(frozen=True)
class SettingLine:
    """The value of one flag and where it comes from."""

    flag: str
    value: str
    origin: str
    commands: str


class SettingList(Report):
    """Flags with their values."""

    flags: tuple[SettingLine, ...]


@command(
    "set",
    example="set --ba_num_iterations=20",
    see_also=("unset", "flags"),
    needs_map=False,
    raw_arguments=True,
    acts_outside=True,
)
def set_flags(context: CommandContext, *assignments: str) -> SettingList | Message:
    """Set flags for the rest of the session; without arguments list them.

    Args:
        assignments: --name=value, name=value, --name or --noname, any number of them.
    """
    if not assignments:
        return list_flags(context)
    given = context.session.set_flags(assignments)
    return Message("\n".join(f"--{setting.name}={setting.text}" for setting in given))


@command(
    "unset",
    example="unset ba_num_iterations",
    needs_map=False,
    raw_arguments=True,
    acts_outside=True,
)
def unset_flags(context: CommandContext, *names: str) -> Message:
    """Remove the values that `set` or --keep_gflags gave to flags.

    Args:
        names: Names of flags.
    """
    if not names:
        raise UserError("unset: no flag is given (see: flags)")
    for name in names:
        if context.session.settings.unset(name) is None:
            raise UserError(f"unset: --{name.lstrip('-')} has not been set")
    return Message("\n".join(f"unset --{name.lstrip('-')}" for name in names))


@command("flags", example="flags ba_", needs_map=False)
def list_flags(context: CommandContext, filter_: str = "") -> SettingList | Message:
    """Show the values of flags and where they come from.

    Without a filter only those that differ from the default are shown.

    Args:
        filter_: Show all flags whose name contains this text.
    """
    registry, current = context.session.registry, context.session.settings.current()
    wanted = filter_.lstrip("-").replace("-", "_")
    every = registry.all_flags()
    names = [n for n in every if wanted in n] if wanted else list(current)
    lines = []
    for name in sorted(names):
        owners = registry.flags_named(name)
        setting = current.get(name)
        value = setting.text if setting else every[name].default_text
        origin = setting.origin if setting else "default"
        lines.append(
            SettingLine(
                f"--{name}", value, origin, _names(c.name for c, _ in owners) or "the console"
            )
        )
    if not lines:
        return Message("no such flag" if wanted else "all flags have their defaults")
    return SettingList(tuple(lines))


def _names(names: Iterable[str], shown: int = 4) -> str:
    listed = list(names)
    more = f" and {len(listed) - shown} more" if len(listed) > shown else ""
    return ", ".join(listed[:shown]) + more
