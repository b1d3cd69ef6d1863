"""Compiled parts of scipy without its packages, which take 0.2 s to import."""

import importlib
import sys
from importlib.machinery import PathFinder
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType

import scipy


def scipy_extension(name: str) -> ModuleType:
    """Return a compiled module; scipy gets the same when it imports its packages later.

    Args:
        name: Its name, e.g. `linalg.cython_blas`.
    """
    full_name = f"scipy.{name}"
    if full_name in sys.modules:
        return sys.modules[full_name]
    folder = Path(scipy.__path__[0], *name.split(".")[:-1])
    spec = PathFinder.find_spec(full_name, [str(folder)])
    if spec is None or spec.loader is None:  # another version of scipy may have it elsewhere
        return importlib.import_module(full_name)
    module = sys.modules[full_name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
