"""The build of the site that `.ci/run` makes: it fails at pages that nobody could find or read."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support.data import REPOSITORY

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed"
)

PAGES = {"index.md": "# Home\n\n[Other](other.md#part)\n", "other.md": "# Other\n\n## Part\n"}


def build(folder: Path, pages: dict[str, str]) -> "subprocess.CompletedProcess[str]":
    """Build a site of some pages, with a menu of two, with the configuration and command of the project."""
    shutil.copytree(REPOSITORY / "docs" / "scripts", folder / "docs" / "scripts")
    shutil.copy(REPOSITORY / "docs" / "site.css", folder / "docs")
    for name, text in pages.items():
        (folder / "docs" / name).write_text(text)
    settings = yaml.safe_load((REPOSITORY / "mkdocs.yml").read_text())
    settings["nav"] = [{"Pages": [*PAGES]}]
    (folder / "mkdocs.yml").write_text(yaml.safe_dump(settings))
    script = (REPOSITORY / ".ci" / "run").read_text()
    command = re.search(
        r"^build_pages\(\) \{ NO_MKDOCS_2_WARNING=1 mkdocs (.*) --site-dir ", script, re.M
    )
    assert command is not None
    words = [
        sys.executable,
        "-m",
        "mkdocs",
        *command[1].split(),
        "--site-dir",
        str(folder / "site"),
    ]
    return subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=120.0, check=False
    )


def test_a_sound_site_is_built(tmp_path: Path) -> None:
    done = build(tmp_path, PAGES)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("pages", "words"),
    [
        ({"other.md": "Text alone.\n", "index.md": "# Home\n"}, "page 'other.md' has no title"),
        ({"index.md": "# Home\n\n[Gone](gone.md)\n"}, "'gone.md'"),
        ({"index.md": "# Home\n\n[Gone](other.md#gone)\n"}, "'other.md#gone'"),
        ({"index.md": "# Home\n\n[Gone](../gone.py)\n"}, "'../gone.py'"),
        ({"lost.md": "# Lost\n"}, "lost.md"),
    ],
    ids=["no title", "dead link", "dead anchor", "dead source", "no menu"],
)
def test_a_planted_fault_fails_the_build(pages: dict[str, str], words: str, tmp_path: Path) -> None:
    done = build(tmp_path, PAGES | pages)
    assert done.returncode == 1
    assert words in done.stderr
