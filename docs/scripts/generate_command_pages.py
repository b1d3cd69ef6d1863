"""Write docs/commands from the registry, and the indexes of decisions and studies.

python docs/scripts/generate_command_pages.py
"""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from maplab_py.console.commands.command import Command
from maplab_py.console.commands.flags import Flag
from maplab_py.console.commands.registry import Plugin, Registry, load_registry

FOLDER = Path(__file__).resolve().parents[1] / "commands"
DECISIONS = FOLDER.with_name("decisions")
STUDIES = FOLDER.with_name("studies")
SHARED = "flags.md"
_FEW = 3  # commands from which a flag with the same help is told once
_NOTE = "<!-- made by docs/scripts/generate_command_pages.py; do not edit -->\n"
_SHARED_HEAD = f"""# Flags of several commands

{_NOTE}
Commands link to these entries; a command with another default says so. Flags that every command has are in
[console](../console.md#flags).
"""


def pages(registry: Registry) -> dict[str, str]:
    """Return the text of every page by file name."""
    plugins = sorted((p for p in registry.plugins if _is_built_in(p)), key=lambda p: p.name)
    shared = SharedFlags(plugins)
    texts = {
        "index.md": _index(plugins),
        SHARED: f"{_SHARED_HEAD}\n{shared.sections(SHARED)}",
    }
    for plugin in plugins:
        texts[f"{plugin.name}.md"] = _page(plugin, shared)
    return texts


def decisions() -> str:
    """Return the list of decision records."""
    purpose = "Choices that would be costly to reverse, why, and what was rejected."
    return _titles_below(DECISIONS, "Decisions", purpose)


def studies() -> str:
    """Return the list of studies."""
    return _titles_below(
        STUDIES, "Studies", "Experiments behind the decisions: question, answer, limits, figures."
    )


def _titles_below(folder: Path, heading: str, purpose: str) -> str:
    lines = [f"# {heading}\n", _NOTE, f"{purpose}\n"]
    for path in sorted(folder.glob("*.md")):
        if path.name != "index.md":
            title = path.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
            lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines) + "\n"


def _is_built_in(plugin: Plugin) -> bool:
    return plugin.module.startswith("maplab_plugins.")


def _index(plugins: list[Plugin]) -> str:
    lines = ["# Commands\n", _NOTE]
    lines += [
        f"[Flags of several commands]({SHARED}) are told once. In the console `help WORDS` searches.\n"
    ]
    for plugin in plugins:
        lines.append(f"## {plugin.name}\n")
        for command in sorted(plugin.commands, key=lambda c: c.name):
            aliases = "".join(f", `{alias}`" for alias in command.aliases)
            link = f"[`{command.name}`]({plugin.name}.md#{command.name})"
            lines.append(f"- {link}{aliases}: {command.summary}")
        lines.append("")
    return "\n".join(lines)


def _page(plugin: Plugin, shared: SharedFlags) -> str:
    parts = [f"# {plugin.name}\n\n{_NOTE}"]
    commands = sorted(plugin.commands, key=lambda c: c.name)
    parts += [_section(command, f"{plugin.name}.md", shared) for command in commands]
    if text := shared.sections(f"{plugin.name}.md"):
        parts.append("## Flags of several commands\n\n" + text)
    return "\n".join(parts)


def _section(command: Command, page: str, shared: SharedFlags) -> str:
    lines = [f"## {command.name}\n", command.summary + "\n"]
    if command.description:
        lines.append(_marked(command.description) + "\n")
    facts = []
    if command.aliases:
        facts.append("Aliases: " + ", ".join(f"`{alias}`" for alias in command.aliases) + ".")
    if command.example != command.name:
        facts.append(f"Example: `{command.example}`.")
    if command.see_also:
        facts.append("See also: " + ", ".join(f"`{name}`" for name in command.see_also) + ".")
    if facts:
        lines.append(" ".join(facts) + "\n")
    entries, links = shared.split(command, page)
    lines += [flag_entry(flag, f"{command.name}-{flag.name}") for flag in entries]
    if links:
        lines.append(f"{'Further flags' if entries else 'Flags'}: {', '.join(links)}.\n")
    return "\n".join(lines)


class SharedFlags:
    """Flags and groups of flags of several commands, each with the page that describes it.

    That is the page of the plugin whose commands have them, and `flags.md` where there are several.
    """

    def __init__(self, plugins: list[Plugin]) -> None:
        owners = {command: plugin.name for plugin in plugins for command in plugin.commands}
        self._groups = _shared_groups(owners)
        users: dict[Any, set[str]] = defaultdict(set)
        counts: dict[Flag, int] = defaultdict(int)
        for command, owner in owners.items():
            for flag in command.flags.values():
                if group := self._group(command.defaults.get(flag.path[0]), flag.path[1:]):
                    users[group].add(owner)
                else:
                    users[_alike(flag)].add(owner)
                    counts[_alike(flag)] += 1
        for group in self._groups:  # and the groups inside groups
            for _, inner in self._flags_of(group):
                if inner:
                    users[inner] |= users[group]
        self._flags = [flag for flag, count in counts.items() if count >= _FEW]
        self._pages = {
            each: f"{min(users[each])}.md" if len(users[each]) == 1 else SHARED
            for each in [*self._flags, *self._groups]
        }
        self._anchors: dict[Any, str] = {}
        taken: dict[tuple[str, str], int] = defaultdict(int)  # names on a page
        entries = [(flag, flag) for flag in self._flags]
        entries += [
            (group, flag)
            for group in self._groups
            for flag, nested in self._flags_of(group)
            if nested is None
        ]
        for home, flag in entries:
            taken[self._pages[home], flag.name] += 1
            rank = taken[self._pages[home], flag.name]
            self._anchors[home, flag.name] = flag.name + (f"_{rank}" if rank > 1 else "")

    def split(self, command: Command, page: str) -> tuple[list[Flag], list[str]]:
        """Return the flags that only this command has, and links to the others."""
        entries: list[Flag] = []
        links: list[str] = []
        groups: dict[type, list[str]] = {}
        for flag in command.flags.values():
            if group := self._group(command.defaults.get(flag.path[0]), flag.path[1:]):
                usual = self._usual(group)[flag.name].default_text
                text = flag.default_text
                differing = groups.setdefault(group, [])
                if text != usual:
                    differing.append(f"`--{flag.name}` {f'`{text}`' if text else 'empty'}")
            elif (alike := _alike(flag)) in self._flags:
                target = f"{self._target(alike, page)}#{self._anchors[alike, flag.name]}"
                links.append(f"[`--{flag.name}`]({target})")
            else:
                entries.append(flag)
        for group, differing in groups.items():
            note = f" (defaults here: {', '.join(differing)})" if differing else ""
            links.append(self._link(group, page) + note)
        return entries, links

    def sections(self, page: str) -> str:
        """Return the entries that a page describes for several commands."""
        lines = [
            flag_entry(flag, self._anchors[flag, flag.name])
            for flag in sorted(self._flags, key=lambda flag: flag.name)
            if self._pages[flag] == page
        ]
        groups = [group for group in self._groups if self._pages[group] == page]
        for group in sorted(groups, key=self._title):
            lines.append(f"### {self._title(group)}\n")
            lines.append(_purpose(group) + ".\n")
            inner: list[type] = []
            for flag, nested in self._flags_of(group):
                if nested is None:
                    lines.append(flag_entry(flag, self._anchors[group, flag.name]))
                elif nested not in inner:
                    inner.append(nested)
            if inner:
                links = ", ".join(self._link(each, page) for each in inner)
                lines.append(f"Further flags: {links}.\n")
        return "\n".join(lines)

    def _flags_of(self, group: type) -> Iterator[tuple[Flag, type | None]]:
        """Yield the flags of a group, and the shared group inside it that describes them."""
        for flag in self._usual(group).values():
            yield flag, self._group(group(), flag.path, outermost=False)

    def _usual(self, group: type) -> dict[str, Flag]:
        """Return the flags of a group by name, with the defaults of the group itself."""
        return self._groups[group]

    def _group(self, value: Any, path: tuple[str, ...], *, outermost: bool = True) -> type | None:
        """Return the first shared group on the way from a value to one of its fields."""
        if outermost and type(value) in self._groups:
            return type(value)
        for name in path[:-1]:
            value = getattr(value, name)
            if type(value) in self._groups:
                return type(value)
        return None

    def _target(self, each: Any, page: str) -> str:
        return "" if self._pages[each] == page else self._pages[each]

    def _link(self, group: type, page: str) -> str:
        title = self._title(group)
        slug = re.sub(r"[^\w\s-]", "", title).strip().lower().replace(" ", "-")
        return f"[{title.removesuffix(' flags')}]({self._target(group, page)}#{slug})"

    def _title(self, group: type) -> str:
        """Return a title from the group's name, or its purpose where two groups have one name."""
        if sum(other.__name__ == group.__name__ for other in self._groups) > 1:
            return _purpose(group)
        words = re.findall(r"[A-Z]+(?![a-z])|[A-Z][a-z]+", group.__name__.removesuffix("Options"))
        return " ".join([words[0], *(w if w.isupper() else w.lower() for w in words[1:]), "flags"])


def flag_entry(flag: Flag, anchor: str) -> str:
    """Return the entry of a flag in a definition list."""
    *choices, last = filter(None, flag.type.text.split("|"))
    facts = f"{', '.join(choices)} or {last}" if choices else last
    facts = "" if flag.type.is_bool else facts
    if flag.is_required:
        facts += ", required"
    elif flag.default_text:
        facts += f" `{flag.default_text}` {flag.unit}"
    term = f"[`--{flag.name}`](#{anchor}){{#{anchor}}}"  # a click shows the address of the entry
    return f"{term} {facts.strip()}".rstrip() + f"\n: {_marked(flag.help)}\n"


def _marked(text: str) -> str:
    """Return a text whose flags are marked as code."""
    parts = text.split("`")  # every other part is code already
    parts[::2] = [re.sub(r"(?<![\w-])--\w+(=[\w./:]*\w)?", r"`\g<0>`", part) for part in parts[::2]]
    return "`".join(parts)


def _shared_groups(commands: Iterable[Command]) -> dict[type, dict[str, Flag]]:
    """Return the option groups that several commands or groups hold, with their flags by name."""
    holders: dict[type, set[Any]] = defaultdict(set)
    flags: dict[type, dict[str, Flag]] = defaultdict(dict)
    for command in commands:
        for flag in command.flags.values():
            value, holder = command.defaults.get(flag.path[0]), command
            for depth in range(1, len(flag.path)):
                group = type(value)
                holders[group].add(holder)
                inner = flag.path[depth:]
                flags[group][flag.name] = replace(flag, path=inner, default=_field(group(), inner))
                value, holder = getattr(value, flag.path[depth]), group
    return {group: flags[group] for group in flags if len(holders[group]) > 1}


def _field(value: Any, path: tuple[str, ...]) -> Any:
    for name in path:
        value = getattr(value, name)
    return value


def _alike(flag: Flag) -> Flag:
    """Return a key that is the same for flags with the same text."""
    return replace(flag, documentation=flag.help, path=())


def _purpose(group: type) -> str:
    return re.split(r"[.;]\s|\.$", (inspect.getdoc(group) or "").split("\n\n")[0])[0]


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
