"""Write docs/migration.md: what becomes of each of maplab's commands, checked against the registry.

python docs/scripts/generate_migration_page.py
"""

from __future__ import annotations

from pathlib import Path

from maplab_py.console.commands.registry import Registry, load_registry

DOCS = Path(__file__).resolve().parents[1]
PAGE = DOCS / "migration.md"
_COMMANDS = Path(__file__).with_name("maplab_commands.tsv")
_HEAD = Path(__file__).with_name("migration_head.txt")


def page(registry: Registry) -> str:
    """Return the page's text."""
    rows = []
    for line in _COMMANDS.read_text(encoding="utf-8").splitlines():
        names, _, note = line.partition("\t")
        name, *aliases = (part.strip() for part in names.split(","))
        shown = ", ".join(f"`{each}`" for each in (name, *aliases))
        rows.append(f"| {shown} | {_here(name, aliases, registry)} | {note} |")
    return _HEAD.read_text(encoding="utf-8") + "\n".join(rows) + "\n"


def _here(name: str, aliases: list[str], registry: Registry) -> str:
    if name.replace("-", "_") not in registry.names and name not in registry.names:
        return "not there yet"
    command = registry.find(name)
    missing = [alias for alias in aliases if alias not in command.names]
    text = f"[`{command.name}`](commands/{registry.owner(command)}.md#{command.name})"
    return f"{text}, without {', '.join(missing)}" if missing else text


if __name__ == "__main__":
    PAGE.write_text(page(load_registry()), encoding="utf-8")
