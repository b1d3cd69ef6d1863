"""Create the package of a new plugin."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.plugin import CommandContext, Report, UserError, command


@dataclasses.dataclass(frozen=True)
class NewPlugin(Report):
    """Files of the new package, and the next steps."""

    folder: Path
    files: tuple[str, ...]
    next_steps: tuple[str, ...]


@command(
    "new_plugin",
    example="new_plugin path_lengths",
    see_also=("plugins",),
    needs_map=False,
    writes_files=True,
)
def new_plugin(context: CommandContext, name: str, *, folder: Path | None = None) -> NewPlugin:
    """Create an installable plugin with one command, one test and a README.

    Args:
        name: Name of the plugin and of its first command.
        folder: Folder to create; empty = maplab_NAME in the current folder. It must not exist.
    """
    from importlib.metadata import version

    from maplab_py.console.commands.plugin_template import plugin_files
    from maplab_py.output_files import write_text

    files = plugin_files(name, version("maplab-py"))
    name = name.replace("-", "_")
    if name in context.session.registry.names:
        raise UserError(f"new_plugin: '{name}' is already a command; give another name")
    target = folder or Path(f"maplab_{name}")
    if target.exists():
        raise UserError(f"new_plugin: {target} exists; give another --folder")
    for path, text in files.items():
        write_text(target / path, [text])
    steps = (f"pip install {target}", f"maplab help {name}", f"pytest {target}/tests")
    return NewPlugin(target, tuple(files), steps)
