"""The decorator that compiles this package's kernels with numba and keeps them on disk.

The cache entry of a kernel is valid as long as its source FILE keeps its time stamp; edits of
jitted functions in other files go unseen. So compiled functions that call each other live in one
file.

Threads that wait for others sleep, as `estimation.linear.jit` explains: OpenMP reads the variable
once, when whichever kernel comes first starts its threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import numba

os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def compiled(**settings: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that compiles a function at its first call and caches it on disk.

    Where no folder can be written the function is compiled anew in every process.

    Args:
        settings: Further settings of `numba.njit`, e.g. `parallel=True`.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            return numba.njit(cache=True, nogil=True, **settings)(function)  # type: ignore[no-any-return]
        except RuntimeError:  # numba: "cannot cache function: no locator available"
            return numba.njit(nogil=True, **settings)(function)  # type: ignore[no-any-return]

    return decorate


prange: Any = numba.prange
