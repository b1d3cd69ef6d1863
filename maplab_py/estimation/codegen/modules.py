"""Generated modules: written once, cached on disk, imported like any other module.

A module's folder is named by a hash over everything that could change what is in it: the sources of
residuals, templates, generator, losses and the list of cameras, and casadi's version. So an edit
anywhere gives a new folder, and a warm start does not import casadi. The modules that a wheel brings
are used with every version of casadi.
"""

import hashlib
import importlib.util
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

from maplab_py import kernel_cache
from maplab_py.atomic import write_file
from maplab_py.progress import SILENT, Progress

_PREFIX = "maplab_py_generated_"
_PACKAGE = Path(__file__).resolve().parents[1]
_TEMPLATES = _PACKAGE / "kernels" / "templates"
_SOURCES = (
    *sorted((_PACKAGE / "symbolic").glob("*.py")),
    *sorted((_PACKAGE / "codegen").glob("*.py")),
    *sorted(_TEMPLATES.glob("*.py")),
    _PACKAGE / "kernels" / "loss.py",
    _PACKAGE.parent / "sensors" / "camera.py",
)
"""Everything that decides what is in a generated module."""


@cache
def cache_folder() -> Path:
    """Return the folder of generated modules; a temporary one where no other can be written.

    MAPLAB_CACHE_DIR names another place than the user's cache directory.

    Raises:
        UserError: Somebody else owns the folder or may write to it.
    """
    return kernel_cache.cache_folder(f"kernels-{source_hash()}-casadi-{version('casadi')}")


def generated_module(
    name: str, make_source: Callable[[], str], progress: Progress = SILENT
) -> ModuleType:
    """Return the module `name`, generating its source at the first use on this machine.

    Args:
        name: Module name: which kernels for which models.
        make_source: Writes the source; called only when the cache does not have it.
    """
    qualified = f"{_PREFIX}{name}"
    if qualified in sys.modules:
        return sys.modules[qualified]
    path = _path(name)
    if not path.exists():
        progress.line(f"compiling kernels '{name}' (once per machine) ...")
        write_file(path, [make_source().encode()], durable=False)
    spec = importlib.util.spec_from_file_location(qualified, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[qualified] = module
    spec.loader.exec_module(module)
    return module


def is_generated(name: str) -> bool:
    """Tell whether the cache has the source of a module; its functions may still be uncompiled."""
    return _path(name).exists()


def _path(name: str) -> Path:
    file = f"{_PREFIX}{name}.py"
    packaged = kernel_cache.PACKAGED.glob(f"kernels-{source_hash()}-*/{file}")
    return next(packaged, None) or cache_folder() / file


def template_source(name: str) -> str:
    """Return the text of a kernel template below the line that ends its preamble."""
    text = (_TEMPLATES / f"{name}.py").read_text(encoding="utf-8")
    return text.split("# --- kernels ---\n", 1)[1]


@cache
def source_hash() -> str:
    """Return a hash of everything in this package that decides what is in a generated module."""
    digest = hashlib.sha256()
    for file in _SOURCES:
        digest.update(file.name.encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]
