"""The beginning of a plugin of one's own."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.plugin import CommandContext, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class NewPlugin(Report):
    """What was made, and what to do with it."""

    folder: Path
    files: tuple[str, ...]
    next_steps: tuple[str, ...]


@command(
    "new_plugin",
    example="new_plugin path_lengths",
    see_also=("plugins",),
    needs_map=False,
    acts_outside=True,
)
def new_plugin(
    context: CommandContext, name: str, *, folder: Path | None = None, dry_run: bool = False
) -> NewPlugin:
    """Make an installable plugin with one command, one test and a README.

    Args:
        name: Name of the plugin and of its first command.
        folder: Where to put it; empty = maplab_NAME in the current folder. It must not exist.
        dry_run: Only tell which files would be written.
    """
    from importlib.metadata import version

    from maplab_py.console.plugin_template import plugin_files

    files = plugin_files(name, version("maplab-py"))
    name = name.replace("-", "_")
    if name in context.session.registry.names:
        raise UserError(f"new_plugin: '{name}' is a command already; give another name")
    target = folder or Path(f"maplab_{name}")
    if target.exists():
        raise UserError(f"new_plugin: {target} exists; give another --folder")
    if not dry_run:
        _write(target, files)
    steps = (f"pip install {target}", f"maplab help {name}", f"pytest {target}/tests")
    return NewPlugin(target, tuple(files), steps)


def _write(target: Path, files: dict[str, str]) -> None:
    try:
        for path, text in files.items():
            (target / path).parent.mkdir(parents=True, exist_ok=True)
            (target / path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{target}: cannot be written: {error.strerror}") from None
