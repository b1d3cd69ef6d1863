"""The decorator that compiles hand-written kernels with numba and keeps them on disk; `prange`.

numba stores machine code beside the source file, or in `NUMBA_CACHE_DIR`, or in the user's cache
folder if the package folder is read-only. An entry is valid as long as the time stamp of the source
file does not change. numba does not notice edits of compiled functions in other files. `compiled`
therefore adds the time stamps of the files whose compiled functions a module imports, so that kernels
may call each other across files. Such imports must stand above the functions that use them.

A module with kernels, or the module that calls them, has a function `compile_kernels`. It calls the
kernels once with small arguments of the types that commands use. The `warmup` modules of `vision`,
`estimation` and `storage` list these functions for `maplab warmup`.

Threads sleep while they wait for others at the end of a parallel loop. By default, GNU OpenMP lets
them spin for milliseconds; on a busy machine every loop then costs a time slice of the scheduler
(measured: 60 ms instead of 2 ms). OpenMP reads the variable when numba loads it, at the first parallel
loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

from maplab_py.kernel_cache import check_trusted

os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def compiled(**settings: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call and caches it on disk.

    Where no folder can be written, every process compiles the function again.

    Division by zero gives infinity or not-a-number, as in numpy. An exception would need a branch at
    each division and increase the compilation time by a tenth.

    Args:
        settings: Further settings of `numba.njit`, e.g. `parallel=True`.

    Raises:
        UserError: Somebody else may write to the folder that NUMBA_CACHE_DIR names.
    """

    settings = {"error_model": "numpy", **settings}
    if os.environ.get("NUMBA_CACHE_DIR"):
        check_trusted(Path(os.environ["NUMBA_CACHE_DIR"]), "NUMBA_CACHE_DIR")

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            kernel = numba.njit(cache=True, nogil=True, **settings)(function)
        except RuntimeError:  # numba: "cannot cache function: no locator available"
            return numba.njit(nogil=True, **settings)(function)  # type: ignore[no-any-return]
        _add_stamps_of_imported_kernels(kernel, function)
        return kernel  # type: ignore[no-any-return]

    return decorate


def _add_stamps_of_imported_kernels(kernel: Any, function: Callable[..., Any]) -> None:
    """Make the cache entry of a kernel depend on the files of imported kernels."""
    source_file = function.__code__.co_filename
    files = {source_file}
    for value in function.__globals__.values():
        files |= getattr(value, "source_files", set())
    kernel.source_files = files
    index = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    if index is None:  # compilation is switched off
        return
    stats = [Path(file).stat() for file in sorted(files - {source_file})]
    stamps = tuple((stat.st_mtime, stat.st_size) for stat in stats)
    if stamps:
        index._source_stamp = (index._source_stamp, stamps)


def is_missing_on_disk(kernel: Callable[..., Any]) -> bool:
    """Tell whether the disk could hold the machine code of a compiled function but does not."""
    stats = getattr(kernel, "stats", None)  # not there where compilation is switched off
    if stats is None or not stats.cache_path:
        return False
    function = kernel.py_func  # type: ignore[attr-defined]
    module = function.__module__.rsplit(".", 1)[-1]
    return not any(Path(stats.cache_path).glob(f"{module}.{function.__qualname__}-*.nbi"))


prange: Any = numba.prange
