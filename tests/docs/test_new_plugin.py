"""`maplab new_plugin` in an environment of its own: installed, listed, run, and its test passed.

The environment has nothing of this one but the libraries, which would take minutes to download.
"""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from maplab_py.console.commands.plugin_template import plugin_files
from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from tests.support.data import REPOSITORY

MOST_TYPED_COMMANDS = 10


def test_names() -> None:
    files = plugin_files("path-lengths", "1.2")
    assert set(files) == {
        "pyproject.toml",
        "README.md",
        "maplab_path_lengths/__init__.py",
        "maplab_path_lengths/py.typed",
        "tests/test_path_lengths.py",
    }
    assert "$" not in "".join(files.values()).replace("$ ", "")
    for name in ("Upper", "1st", "a b", "../x", ""):
        with pytest.raises(UserError, match="cannot be a name"):
            plugin_files(name, "1.2")


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    session = Session()
    with pytest.raises(UserError, match="exists"):
        session.run("new_plugin", "path_lengths", folder=tmp_path)
    with pytest.raises(UserError, match="is already a command"):
        session.run("new_plugin", "load", folder=tmp_path / "x")
    session.run("new_plugin", "path_lengths", folder=tmp_path / "x", dry_run=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_from_a_clean_environment(tmp_path: Path) -> None:
    environment = tmp_path / "venv"
    venv.create(environment, with_pip=False, symlinks=True)
    python = environment / "bin" / "python"
    site = Path(_run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"))
    libraries = [path for path in sys.path if "site-packages" in path]
    _pip(site, REPOSITORY)
    (site / "zz_libraries.pth").write_text("\n".join(libraries) + "\n")
    typed = 0

    def maplab(*words: str) -> str:
        nonlocal typed
        typed += 1
        return _run(python, "-m", "maplab_py", *words, folder=tmp_path)

    assert str(site) in _run(
        python, "-c", "import maplab_py; print(maplab_py.__file__)", folder=tmp_path
    )
    maplab("new-plugin", "path_lengths")
    _pip(site, tmp_path / "maplab_path_lengths")
    typed += 1
    plugins = json.loads(maplab("--json", "plugins"))["report"]["plugins"]
    assert {"plugin": "path_lengths", "problem": ""}.items() <= next(
        p for p in plugins if p["plugin"] == "path_lengths"
    ).items()
    assert "--max_step_m" in maplab("help", "path_lengths")
    done = _run(python, "-m", "pytest", "-q", "maplab_path_lengths/tests", folder=tmp_path)
    typed += 1
    assert "2 passed" in done
    assert typed <= MOST_TYPED_COMMANDS


def _pip(site: Path, source: Path) -> None:
    words = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--target", str(site)]
    _run(sys.executable, "-m", "pip", *words, str(source))


def _run(*words: str | Path, folder: Path | None = None) -> str:
    done = subprocess.run(
        [str(word) for word in words],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "MAPLAB_WHEEL_KERNELS": "none"},  # those of the cache serve as well
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()
