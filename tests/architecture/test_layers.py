"""The layers of the architecture, and the size of its parts."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.data import REPOSITORY

SOURCES = sorted(
    path
    for folder in ("maplab_py", "plugins")
    for path in (REPOSITORY / folder).rglob("*.py")
    if not path.name.endswith("_pb2.py")
)
HEAVY = (
    "casadi",
    "scipy",
    "numba",
    "cv2",
    "pycolmap",
    "viser",
    "rich",
    "prompt_toolkit",
    "yaml",
    "matplotlib",
)

HOMES = {
    "casadi": ("estimation",),
    "numba": ("compilation.py", "estimation"),
    "pycolmap": ("interop",),
    "viser": ("viewer",),
    "prompt_toolkit": ("console",),
    "matplotlib": ("plotting",),
    "rich": ("console", "viewer/display"),
}


def test_import_contracts_hold() -> None:
    program = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run(
        [str(program), "--no-cache"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys; from maplab_py.console.main import main; status = main(['-c', 'help']); "
        f"print(sorted(set({HEAVY}) & set(sys.modules)), file=sys.stderr); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert done.stderr.splitlines()[-1] == "[]"


@pytest.mark.parametrize(("library", "homes"), HOMES.items())
def test_heavy_libraries_stay_at_home(library: str, homes: tuple[str, ...]) -> None:
    strangers = [
        str(path.relative_to(REPOSITORY))
        for path in SOURCES
        if library in _imported(path)
        and not str(path.relative_to(REPOSITORY)).startswith(tuple(f"maplab_py/{h}" for h in homes))
    ]
    assert strangers == []


def _imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            names.add((node.module or "").partition(".")[0])
    return names


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_files_and_functions_are_short(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) < 500
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.end_lineno:
            length = node.end_lineno - node.lineno + 1
            assert length <= 80, f"{node.name} has {length} lines"
