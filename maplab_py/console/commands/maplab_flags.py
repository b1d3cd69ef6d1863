"""maplab's flags that have no namesake here: what they are called, or why they were dropped."""

from __future__ import annotations

import dataclasses
import enum
from importlib import resources

TABLE = "maplab_flags.tsv"


class Fate(enum.Enum):
    """Fate of a flag of maplab."""

    RENAMED = "renamed"
    DROPPED = "dropped"


@dataclasses.dataclass(frozen=True)
class FormerFlag:
    """One flag of maplab.

    Attributes:
        fate: What became of it.
        new_name: Its name here without dashes; empty for a dropped one.
        note: How the new one differs, may be empty; why it was dropped.
    """

    fate: Fate
    new_name: str
    note: str


def former_flags() -> dict[str, FormerFlag]:
    """Return the flags by maplab's names.

    Raises:
        ValueError: The table is wrong.
    """
    text = resources.files(__package__).joinpath(TABLE).read_text(encoding="utf-8")
    return parse_table(text)


def parse_table(text: str) -> dict[str, FormerFlag]:
    """Parse lines of names (separated by ", "), fate and text, separated by tabs.

    Raises:
        ValueError: A line is wrong, or a name is in two lines.
    """
    flags: dict[str, FormerFlag] = {}
    for line in text.splitlines():
        names, fate, note = line.split("\t")
        new_name = ""
        if fate == Fate.RENAMED.value:
            new_name, _, note = note.removeprefix("--").partition(": ")
        for name in names.split(", "):
            if name in flags or not (new_name or note):
                raise ValueError(f"{TABLE}: the line of '{name}' is wrong")
            flags[name] = FormerFlag(Fate(fate), new_name, note)
    return flags


def explanation(name: str) -> str:
    """Return the end of an error about an unknown flag; empty where maplab has no such flag."""
    flag = former_flags().get(name)
    if flag is None:
        return ""
    if flag.fate is Fate.RENAMED:
        return f": here it is --{flag.new_name}{f' ({flag.note})' if flag.note else ''}"
    return f": maplab's flag is not needed here: {flag.note}"
