"""Code blocks of the documentation."""

import re
from pathlib import Path

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")


def blocks(path: Path, *languages: str) -> list[tuple[str, str]]:
    """Return (language, text) of the fenced blocks in these languages, in order."""
    found = _BLOCK.findall(path.read_text(encoding="utf-8"))
    return [(language, text) for language, text in found if language in languages]


def links(path: Path) -> list[str]:
    """Return the targets of links to files."""
    found: list[str] = _LINK.findall(path.read_text(encoding="utf-8"))
    return [target for target in found if "://" not in target]
