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
    "trimesh",
    "viser",
    "rich",
    "prompt_toolkit",
    "yaml",
    "matplotlib",
    "rosbags",
    "cyclonedds",
    "websockets",
    "rerun",
    "small_gicp",
    "kiss_matcher",
    "distributed",
    "dask",
)

HOMES = {
    "casadi": ("estimation",),
    "numba": ("compilation.py",),
    "pycolmap": ("interop",),
    "trimesh": ("interop",),
    "viser": ("viewer",),
    "prompt_toolkit": ("console",),
    "matplotlib": ("plotting",),
    "rosbags": ("interop/recordings",),
    "cyclonedds": ("interop/live",),
    "websockets": ("interop/live", "viewer/display"),
    "rerun": ("viewer/display",),
    "small_gicp": ("algorithms/cloud_registration",),
    "kiss_matcher": ("algorithms/cloud_registration",),
    "rich": ("console", "viewer/display"),
    "distributed": ("pipeline/cluster.py",),
    "dask": ("pipeline/cluster.py",),
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


WRITERS = {"replace", "rename", "mkstemp", "NamedTemporaryFile", "write_text", "write_bytes"}
MAY_WRITE = (
    "maplab_py/atomic/",
    "maplab_py/storage/map_saving.py",  # into the folder that `replaced_folder` gives
    "maplab_py/storage/checksums.py",
    "plugins/maplab_plugins/console/session.py",
    "maplab_py/console/commands/plugin_template.py",  # text of a test
    "maplab_py/console/terminal/output.py",  # a transcript is appended to
    "maplab_py/interop/colmap/child.py",  # databases and models in a temporary folder
    "maplab_py/interop/colmap/child_process.py",  # likewise
    "maplab_py/pipeline/execution.py",  # output and log of a running task
    "maplab_py/server/status.py",  # likewise
    "maplab_py/server/worker.py",  # likewise
)


def test_only_the_atomic_module_puts_files_in_place() -> None:
    found = [
        f"{name}:{line}"
        for path in SOURCES
        if not (name := str(path.relative_to(REPOSITORY))).startswith(MAY_WRITE)
        for line in _writing_lines(path)
    ]
    assert found == []


def _writing_lines(path: Path) -> list[int]:
    """Return the lines that open a file for writing, rename one or make a temporary one."""
    lines = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        function = node.func
        owner = getattr(getattr(function, "value", None), "id", "")
        name = function.attr if isinstance(function, ast.Attribute) else ""
        words = [a.value for a in node.args[:2] if isinstance(a, ast.Constant)]
        opens = name == "open" or getattr(function, "id", "") == "open"
        if opens and any(isinstance(w, str) and set(w) & set("wax+") for w in words):
            lines.append(node.lineno)
        is_path = name in ("write_text", "write_bytes") or owner in ("os", "tempfile", "path")
        if name in WRITERS and is_path:
            lines.append(node.lineno)
    return lines


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_files_and_functions_are_short(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) < 500
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.end_lineno:
            length = node.end_lineno - node.lineno + 1
            assert length <= 80, f"{node.name} has {length} lines"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(REPOSITORY)))
def test_kernels_take_few_arguments(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            decorators = {ast.unparse(d).partition("(")[0] for d in node.decorator_list}
            if decorators & {"compiled", "njit"}:
                assert len(node.args.args) <= 10, f"{node.name} has {len(node.args.args)}"
