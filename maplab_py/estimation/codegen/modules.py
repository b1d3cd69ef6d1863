"""Generated modules: written once, cached on disk, imported like any other module.

A module's folder is named by a hash over everything that could change what is in it: all source
files of the estimation package and the versions of casadi, numba, numpy and Python. numba keeps its
compiled code beside the module. So an edit anywhere gives a new folder, and a warm start imports
neither casadi nor the compiler's front end.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from maplab_py.progress import SILENT, Progress

_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = ("symbolic", "codegen", "templates")


@cache
def cache_folder() -> Path:
    """Return the folder of generated modules; a temporary one where no other can be written.

    MAPLAB_CACHE_DIR names another place than the user's cache directory.
    """
    configured = os.environ.get("MAPLAB_CACHE_DIR", "")
    base = os.environ.get("XDG_CACHE_HOME", "") or str(Path.home() / ".cache")
    root = Path(configured) if configured else Path(base) / "maplab_py"
    folder = root / f"kernels-{_source_hash()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="maplab-kernels-"))
    return folder


def generated_module(
    name: str, make_source: Callable[[], str], progress: Progress = SILENT
) -> ModuleType:
    """Return the module `name`, generating its source at the first use on this machine.

    Args:
        name: Module name: which kernels for which models.
        make_source: Writes the source; called only when the cache does not have it.
        progress: Told when something has to be generated and compiled.
    """
    qualified = f"maplab_py_generated_{name}"
    if qualified in sys.modules:
        return sys.modules[qualified]
    path = cache_folder() / f"{qualified}.py"
    if not path.exists():
        progress.line(f"compiling kernels '{name}' (once per machine) ...")
        _write_atomically(path, make_source())
    spec = importlib.util.spec_from_file_location(qualified, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[qualified] = module
    spec.loader.exec_module(module)
    return module


def template_source(name: str) -> str:
    """Return the text of a kernel template below the line that ends its preamble."""
    text = (_PACKAGE / "templates" / f"{name}.py").read_text(encoding="utf-8")
    return text.split("# --- kernels ---\n", 1)[1]


def _write_atomically(path: Path, source: str) -> None:
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8"
    ) as file:
        file.write(source)
    Path(file.name).replace(path)


def _source_hash() -> str:
    digest = hashlib.sha256()
    for folder in _SOURCES:
        for file in sorted((_PACKAGE / folder).glob("*.py")):
            digest.update(file.name.encode())
            digest.update(file.read_bytes())
    for package in ("casadi", "numba", "numpy"):
        digest.update(f"{package} {version(package)}".encode())
    digest.update(sys.version.encode())
    return digest.hexdigest()[:16]
