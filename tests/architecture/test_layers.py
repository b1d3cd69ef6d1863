"""The layers of the architecture, and the size of its parts."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.support.data import REPOSITORY

SOURCES = {
    str(path.relative_to(REPOSITORY)): ast.parse(path.read_text(encoding="utf-8"))
    for folder in ("maplab_py", "plugins")
    for path in sorted((REPOSITORY / folder).rglob("*.py"))
    if not path.name.endswith("_pb2.py")
}
"""Syntax trees of the product's files."""
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
    "numba": ("compilation.py", "numba_changes.py"),
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


def test_heavy_libraries_stay_at_home() -> None:
    strangers = [
        f"{path} imports {library}"
        for path, tree in SOURCES.items()
        for library in _imported(tree) & HOMES.keys()
        if not path.startswith(tuple(f"maplab_py/{home}" for home in HOMES[library]))
    ]
    assert strangers == []


def _imported(tree: ast.AST) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
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
    "maplab_py/interop/colmap/pycolmap_files.py",  # models in a temporary folder
    "maplab_py/pipeline/execution.py",  # output and log of a running task
    "maplab_py/server/status.py",  # likewise
    "maplab_py/server/worker.py",  # likewise
)


def test_only_the_atomic_module_puts_files_in_place() -> None:
    found = [
        f"{path}:{line}"
        for path, tree in SOURCES.items()
        if not path.startswith(MAY_WRITE)
        for line in _writing_lines(tree)
    ]
    assert found == []


def _writing_lines(tree: ast.AST) -> list[int]:
    """Return the lines that open a file for writing, rename one or make a temporary one."""
    lines = []
    for node in ast.walk(tree):
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


def _functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    for path, tree in SOURCES.items():
        for node in ast.walk(tree):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                yield f"{path}:{node.lineno} {node.name}", node


def test_files_and_functions_are_short() -> None:
    lengths = {path: len((REPOSITORY / path).read_text().splitlines()) for path in SOURCES}
    assert {path: length for path, length in lengths.items() if length >= 500} == {}
    long = [name for name, node in _functions() if (node.end_lineno or 0) - node.lineno >= 80]
    assert long == []


def test_kernels_take_few_arguments() -> None:
    arguments = {
        name: len(node.args.args)
        for name, node in _functions()
        if {ast.unparse(d).partition("(")[0] for d in node.decorator_list} & {"compiled", "njit"}
    }
    assert len(arguments) > 100
    assert {name: count for name, count in arguments.items() if count > 10} == {}
