"""Aliases of command lines."""

from __future__ import annotations

import dataclasses

from maplab_py.plugin import CommandContext, Message, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class AliasLine:
    """One alias."""

    alias: str
    stands_for: str


@dataclasses.dataclass(frozen=True)
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
