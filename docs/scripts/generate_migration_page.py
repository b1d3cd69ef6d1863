"""Write docs/migration.md and docs/migration_flags.md: what became of maplab's commands and flags.

python docs/scripts/generate_migration_page.py

Both pages are checked against the registry: a command or a flag of maplab that is neither there nor
explained in a table (commands: beside this file, flags: in the package, which tells users) is an error.
"""

from pathlib import Path

from maplab_py.console.commands.flags import COMMON_FLAGS, TABLE, Fate, former_flags
from maplab_py.console.commands.registry import Registry, load_registry

DOCS = Path(__file__).resolve().parents[1]
PAGE = DOCS / "migration.md"
FLAGS_PAGE = DOCS / "migration_flags.md"
COMMANDS = Path(__file__).with_name("maplab_commands.tsv")
FLAG_NAMES = Path(__file__).with_name("maplab_flag_names.tsv")
_HEAD = Path(__file__).with_name("migration_head.txt")
_FLAGS_HEAD = Path(__file__).with_name("migration_flags_head.txt")


def page(registry: Registry) -> str:
    """Return the text of the page of commands.

    Raises:
        ValueError: A command of maplab is neither in the registry nor explained.
    """
    same, others = [], []
    for names, note in command_table():
        here = _here(names, note, registry)
        if here.startswith(f"[`{names[0]}`]") and here.endswith(")") and not note:
            same.append(here)
            continue
        aliases = "".join(f", `{alias}`" for alias in names[1:])
        is_same = here.startswith(f"[`{names[0]}`]")
        entry = here.replace(")", f"){aliases}", 1) if is_same else f"`{names[0]}`{aliases}: {here}"
        others.append(f"- {entry}: {note}".rstrip(": "))
    head = _HEAD.read_text(encoding="utf-8")
    return f"{head}{', '.join(same)}.\n\nOthers differ:\n\n" + "\n".join(others) + "\n"


def command_table() -> list[tuple[list[str], str]]:
    """Return name and aliases of each of maplab's commands, with the note on it."""
    table = []
    for line in COMMANDS.read_text(encoding="utf-8").splitlines():
        names, _, note = line.partition("\t")
        table.append(([part.strip() for part in names.split(",")], note))
    return table


def _here(names: list[str], note: str, registry: Registry) -> str:
    name, *aliases = names
    if name.replace("-", "_") not in registry.names and name not in registry.names:
        if not note:
            raise ValueError(f"{COMMANDS.name}: '{name}' is no command here and has no reason")
        return "dropped"
    command = registry.find(name)
    missing = [alias for alias in aliases if alias not in command.names]
    text = f"[`{command.name}`](commands/{registry.owner(command)}.md#{command.name})"
    return f"{text}, without {', '.join(missing)}" if missing else text


def flags_page(registry: Registry) -> str:
    """Return the text of the page of flags: one list per module, flags of one fate in one entry.

    Raises:
        ValueError: A flag of maplab is neither in the registry nor explained, or is both, or a new
            name is no flag.
    """
    elsewhere = _explained(registry)
    modules: dict[str, dict[tuple[str, str], list[str]]] = {}
    for module, name in flag_names():
        fates = modules.setdefault(module, {})
        fates.setdefault(_fate(name, elsewhere, registry), []).append(name)
    parts = [_FLAGS_HEAD.read_text(encoding="utf-8")]
    for module, fates in modules.items():
        parts.append(f"\n## {module}\n\n")
        for (fate, text), names in fates.items():
            note = f"{fate}; {text}" if text else fate
            parts.append(f"- {', '.join(f'`{name}`' for name in names)}: {note}\n")
    return "".join(parts)


def flag_names() -> list[tuple[str, str]]:
    """Return the module and the name of each of maplab's flags; some names are in two modules."""
    lines = FLAG_NAMES.read_text(encoding="utf-8").splitlines()
    return [(module, name) for module, _, name in (line.partition("\t") for line in lines)]


def _explained(registry: Registry) -> dict[str, tuple[str, str]]:
    """Return fate and text of the flags that have no namesake here."""
    known = {name for _, name in flag_names()}
    fates: dict[str, tuple[str, str]] = {}
    for name, flag in former_flags().items():
        if name not in known:
            raise ValueError(f"{TABLE}: the line of '{name}' is wrong: maplab has no such flag")
        if flag.fate is Fate.RENAMED and not registry.flags_named(flag.new_name):
            raise ValueError(f"{TABLE}: no command has the flag --{flag.new_name}")
        new_name = f"`--{flag.new_name}`" if flag.new_name else ""
        fates[name] = flag.fate.value, ": ".join(filter(None, (new_name, flag.note)))
    return fates


def _fate(name: str, elsewhere: dict[str, tuple[str, str]], registry: Registry) -> tuple[str, str]:
    commands = [command for command, _ in registry.flags_named(name)]
    if (bool(commands) or name in COMMON_FLAGS) == (name in elsewhere):
        reason = "has a namesake here and a line" if name in elsewhere else "has neither"
        raise ValueError(f"{TABLE}: flag '{name}' {reason}")
    if name in elsewhere:
        return elsewhere[name]
    return "same name", ""


def main() -> None:
    """Rewrite both pages."""
    registry = load_registry()
    PAGE.write_text(page(registry), encoding="utf-8")
    FLAGS_PAGE.write_text(flags_page(registry), encoding="utf-8")


if __name__ == "__main__":
    main()
