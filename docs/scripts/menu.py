"""Hooks of mkdocs: folders in the menu, titles of pages, and links to sources of the repository."""

import logging
import re
from pathlib import Path
from typing import Any

logger = logging.getLogger("mkdocs.hooks.menu")  # warnings of mkdocs fail a strict build


def on_config(config: Any) -> Any:
    """Replace the folders in the menu by their pages.

    Args:
        config: The configuration of mkdocs.

    Returns:
        The configuration.
    """
    config.nav = _expand(config.nav, Path(config.docs_dir))
    return config


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Turn links to files of the repository outside docs, which the site does not have, into code.

    The search ranks decisions and studies below the users' pages. A page without a title is warned of.

    Args:
        markdown: Text of a page.
        page: The page.

    Returns:
        The text; links to files that do not exist stay, and fail the build.
    """
    if page.file.src_uri.startswith(("decisions/", "studies/")):
        page.meta.setdefault("search", {"boost": 0.3})
    if re.search(r"^# \S", markdown, re.MULTILINE) is None:
        logger.warning("page '%s' has no title: begin it with '# Title'", page.file.src_uri)
    source = Path(page.file.abs_src_path)
    docs = Path(__file__).resolve().parents[1]

    def as_code(match: re.Match[str]) -> str:
        target = (source.parent / match[2]).resolve()
        is_source = target.exists() and not target.is_relative_to(docs)
        return f"`{match[1]}`" if is_source else match[0]

    return re.sub(r"\[([^\]`]+)\]\((\.\./[^)#]+)\)", as_code, markdown)


def _expand(entry: Any, docs: Path) -> Any:
    if isinstance(entry, list):
        return [_expand(each, docs) for each in entry]
    if isinstance(entry, dict):
        return {title: _expand(each, docs) for title, each in entry.items()}
    if not entry.endswith("/"):
        return entry
    names = sorted(path.name for path in (docs / entry).glob("*.md") if path.name != "index.md")
    return [entry + name for name in ("index.md", *names)]
