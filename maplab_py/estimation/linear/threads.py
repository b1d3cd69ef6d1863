"""Keep OpenBLAS on one thread while many small matrices are factorised.

With more threads OpenBLAS is 25 to 70 times slower on the small fronts of a sparse factorisation,
and its sums depend on the thread count. threadpoolctl needs some milliseconds to find the
libraries, so that is done once; entering the context costs some 20 microseconds, inside another
one almost nothing.

Parallel loops over a handful of edges do not pay either: the other thread has to be woken first, which on
a busy machine takes longer than the loop itself (measured: 0.5 ms for 9 inertial edges that need 10
microseconds).
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from maplab_py.compilation import numba
from maplab_py.estimation.linear.scipy_extensions import scipy_extension


@cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    scipy_extension("linalg.cython_blas")  # loads the library that is to be found
    return ThreadpoolController().select(user_api="blas")


class _Limit:
    """The limit of the process, and how many blocks of code need it now."""

    lock = threading.Lock()
    users = 0
    held: Any = None


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Run the body with one BLAS thread; may be nested. Applies to the whole process."""
    with _Limit.lock:
        if _Limit.users == 0:
            _Limit.held = _controller().limit(limits=1)
        _Limit.users += 1
    try:
        yield
    finally:
        with _Limit.lock:
            _Limit.users -= 1
            if _Limit.users == 0:
                _Limit.held.restore_original_limits()


@contextmanager
def single_thread() -> Iterator[None]:
    """Run the body with one BLAS thread, and its compiled loops on the calling thread alone.

    For problems of some tens of poses. The number of BLAS threads applies to the whole process, that of
    compiled loops to the calling thread.
    """
    before = numba.get_num_threads()
    with single_blas_thread():
        numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(before)
