"""Commands for tests of the whole console: what the session holds, and putting it back."""

from typing import Any

from maplab_py.console.session.maps import MapsState
from maplab_py.plugin import CommandContext, Message, command

_remembered: dict[str, MapsState] = {}


@command("remember_state", example="remember_state a", needs_map=False)
def remember_state(context: CommandContext, name: str) -> Message:
    """Remember all maps.

    Args:
        name: Under which name.
    """
    _remembered[name] = context.maps.state
    return Message(f"remembered {name}")


@command("put_back_state", example="put_back_state a", needs_map=False)
def put_back_state(context: CommandContext, name: str) -> Message:
    """Put back all maps that were remembered.

    Args:
        name: Under which name.
    """
    context.maps.state = _remembered[name]
    return Message(f"put back {name}")


@command("digest_state", example="digest_state", needs_map=False)
def digest_state(context: CommandContext) -> Message:
    """Print a checksum of every byte of all maps, their keys and folders."""
    from tests.registry.workspace import digest

    entries: list[Any] = []
    for entry in context.maps:
        history = [step.command for step in (*entry.past, *entry.future)]
        entries += [entry.key, entry.folder, entry.is_saved, history, entry.vi_map]
    return Message(f"digest {digest([context.maps.selected_key, entries])[:32]} end")


@command("mark_state", example="mark_state 1", needs_map=False)
def mark_state(context: CommandContext, number: str) -> Message:
    """Print a number, to tell which output belongs to which line.

    Args:
        number: Any.
    """
    return Message(f"mark {number} end")
