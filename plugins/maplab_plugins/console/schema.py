"""JSON schema of the output of --json."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

from maplab_py.plugin import CommandContext, Report, command


@dataclasses.dataclass(frozen=True)
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
