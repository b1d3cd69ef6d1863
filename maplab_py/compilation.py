"""The decorator that compiles hand-written kernels with numba and keeps them on disk; `prange`.

numba stores machine code beside the source file, or in `NUMBA_CACHE_DIR`, or in the user's cache
folder when the package folder is read-only; the entry is valid as long as the source FILE keeps
its time stamp. It does not see edits of jitted functions in other files. The rule of this package
is therefore: compiled functions that call each other live in one file.

Threads that wait for others at the end of a parallel loop sleep: GNU OpenMP would let them spin for
milliseconds, and on a machine that does other work too every loop then costs a time slice of the
scheduler (measured: 60 ms instead of 2 ms). OpenMP reads the variable when it is loaded, which
numba does at the first parallel loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def compiled(**settings: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call and caches it on disk.

    Where no folder can be written the function is compiled anew in every process.

    Division by zero gives infinity or not-a-number as in numpy: to raise an error instead would put
    a branch at each division and cost a tenth of the time to compile.

    Args:
        settings: Further settings of `numba.njit`, e.g. `parallel=True`.
    """

    settings = {"error_model": "numpy", **settings}

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(cache=True, nogil=True, **settings)(function)  # type: ignore[no-any-return]
        except RuntimeError:  # numba: "cannot cache function: no locator available"
            return numba.njit(nogil=True, **settings)(function)  # type: ignore[no-any-return]

    return decorate


def is_missing_on_disk(kernel: Callable[..., Any]) -> bool:
    """Tell whether machine code of a compiled function could be kept on the disk, but is not there."""
    stats = getattr(kernel, "stats", None)  # not there where compilation is switched off
    if stats is None or not stats.cache_path:
        return False
    function = kernel.py_func  # type: ignore[attr-defined]
    module = function.__module__.rsplit(".", 1)[-1]
    return not any(Path(stats.cache_path).glob(f"{module}.{function.__qualname__}-*.nbi"))


prange: Any = numba.prange
