"""Write docs/commands from the registry, and the indexes of decisions and studies.

python docs/scripts/generate_command_pages.py
"""

from __future__ import annotations

from pathlib import Path

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag
from maplab_py.console.commands.registry import Plugin, Registry, load_registry

FOLDER = Path(__file__).resolve().parents[1] / "commands"
DECISIONS = FOLDER.with_name("decisions")
STUDIES = FOLDER.with_name("studies")
_NOTE = "<!-- made by docs/scripts/generate_command_pages.py; do not edit -->\n"


def pages(registry: Registry) -> dict[str, str]:
    """Return the text of every page by file name."""
    plugins = sorted((p for p in registry.plugins if _is_built_in(p)), key=lambda p: p.name)
    texts = {"index.md": _index(plugins)}
    for plugin in plugins:
        texts[f"{plugin.name}.md"] = _page(plugin)
    return texts


def decisions() -> str:
    """Return the list of decision records."""
    lines = [_NOTE, "# Decisions\n"]
    lines += ["Choices that would be costly to reverse, why, and what was rejected.\n"]
    for path in sorted(DECISIONS.glob("0*.md")):
        title = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines) + "\n"


def studies() -> str:
    """Return the list of studies, each with the question that it answers."""
    lines = [_NOTE, "# Studies\n"]
    lines += ["Experiments behind the decisions: question, answer, limits, figures.\n"]
    for path in sorted(STUDIES.glob("*.md")):
        if path.name == "index.md":
            continue
        text = path.read_text(encoding="utf-8")
        title = text.splitlines()[0].lstrip("# ")
        question = text.split("**Question.** ", 1)[1].split("\n\n", 1)[0]
        lines.append(f"- [{title}]({path.name}): {' '.join(question.split())}")
    return "\n".join(lines) + "\n"


def _is_built_in(plugin: Plugin) -> bool:
    return plugin.module.startswith("maplab_plugins.")


def _index(plugins: list[Plugin]) -> str:
    lines = [_NOTE, "# Commands\n", "| command | alias | what it does |", "|---|---|---|"]
    found = [(command, plugin.name) for plugin in plugins for command in plugin.commands]
    for command, plugin_name in sorted(found, key=lambda pair: pair[0].name):
        aliases = ", ".join(f"`{alias}`" for alias in command.aliases)
        link = f"[`{command.name}`]({plugin_name}.md#{command.name})"
        lines.append(f"| {link} | {aliases} | {_cell(command.summary)} |")
    return "\n".join(lines) + "\n"


def _page(plugin: Plugin) -> str:
    parts = [_NOTE + f"\n# {plugin.name}\n"]
    parts += [_section(command) for command in sorted(plugin.commands, key=lambda c: c.name)]
    return "\n".join(parts)


def _section(command: Command) -> str:
    lines = [f"## {command.name}\n", command.summary + "\n"]
    if command.description:
        lines.append(command.description + "\n")
    if command.aliases:
        lines.append("Aliases: " + ", ".join(f"`{alias}`" for alias in command.aliases) + "\n")
    if command.example != command.name:
        lines.append(f"Example: `{command.example}`\n")
    if command.see_also:
        lines.append("See also: " + ", ".join(f"`{name}`" for name in command.see_also) + "\n")
    if command.flags:
        lines += ["| flag | type | default | unit | |", "|---|---|---|---|---|"]
        lines += [_flag_row(flag) for flag in command.flags.values()]
        lines.append("")
    return "\n".join(lines)


def _flag_row(flag: Flag) -> str:
    default = f"`{_cell(flag.default_text)}`" if flag.default_text else ""
    kind = _cell(flag.type.text)
    return f"| `--{flag.name}` | {kind} | {default} | {flag.unit} | {_cell(flag.help)} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def main() -> None:
    """Rewrite the folder."""
    registry = load_registry()
    if registry.problems:
        raise SystemExit("\n".join(registry.problems))
    FOLDER.mkdir(exist_ok=True)
    texts = pages(registry)
    for stale in set(FOLDER.glob("*.md")) - {FOLDER / name for name in texts}:
        stale.unlink()
    for name, text in texts.items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    (DECISIONS / "index.md").write_text(decisions(), encoding="utf-8")
    (STUDIES / "index.md").write_text(studies(), encoding="utf-8")


if __name__ == "__main__":
    main()
