"""A hook of mkdocs: a folder in the menu stands for all of its pages, its index first."""

from __future__ import annotations

from pathlib import Path
from typing import Any


def on_config(config: Any) -> Any:
    """Replace the folders in the menu by their pages.

    Args:
        config: The configuration of mkdocs.

    Returns:
        The configuration.
    """
    config.nav = _expand(config.nav, Path(config.docs_dir))
    return config


def _expand(entry: Any, docs: Path) -> Any:
    if isinstance(entry, list):
        return [_expand(each, docs) for each in entry]
    if isinstance(entry, dict):
        return {title: _expand(each, docs) for title, each in entry.items()}
    if not entry.endswith("/"):
        return entry
    names = sorted(path.name for path in (docs / entry).glob("*.md") if path.name != "index.md")
    return [entry + name for name in ("index.md", *names)]
