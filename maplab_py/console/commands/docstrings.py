"""Parser of a command's docstring: the summary, the description, and its `Args:`."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

_SECTION = re.compile(r"^(Args|Returns|Raises|Examples?|Yields|Note|Notes):\s*$")
_ARGUMENT = re.compile(r"^ {2,8}\*{0,2}(\w+)(?: \([^)]*\))?:\s*(.*)$")


@dataclasses.dataclass(frozen=True)
class Documentation:
    """A docstring taken apart."""

    summary: str
    description: str
    arguments: Mapping[str, str]


def parse_docstring(function: Callable[..., Any]) -> Documentation:
    """Take the docstring of a function apart (Google style)."""
    lines = (inspect.getdoc(function) or "").splitlines()
    prose: list[str] = []
    arguments: dict[str, str] = {}
    section = ""
    name = ""
    for line in lines:
        heading = _SECTION.match(line)
        if heading:
            section, name = heading.group(1), ""
            continue
        if not section:
            prose.append(line)
            continue
        if section != "Args":
            continue
        entry = _ARGUMENT.match(line)
        if entry:
            name = entry.group(1)
            arguments[name] = entry.group(2).strip()
        elif name and line.strip():
            arguments[name] += " " + line.strip()
    summary, _, description = "\n".join(prose).strip().partition("\n\n")
    return Documentation(" ".join(summary.split()), description.strip(), arguments)
