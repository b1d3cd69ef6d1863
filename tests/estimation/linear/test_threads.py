from __future__ import annotations

import numba
import pytest
from threadpoolctl import threadpool_info

from maplab_py.estimation.linear.threads import single_blas_thread, single_thread


def blas_threads() -> list[int]:
    """Return the threads of numpy's and scipy's libraries; OpenCV has its own, which no solver uses."""
    blas = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    return [pool["num_threads"] for pool in blas if "opencv" not in pool["filepath"]]


def test_the_limit_lasts_until_the_last_user_leaves():
    with single_blas_thread():  # finds the libraries
        pass
    before = blas_threads()
    first, second = single_blas_thread(), single_blas_thread()
    first.__enter__()
    second.__enter__()
    assert set(blas_threads()) == {1}
    first.__exit__(None, None, None)  # threads may leave in any order
    assert set(blas_threads()) == {1}
    second.__exit__(None, None, None)
    assert blas_threads() == before


def test_compiled_loops_have_a_single_thread_until_the_end_or_an_error():
    before, inside = numba.get_num_threads(), []

    def fail():
        inside.append(numba.get_num_threads())
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), single_thread():
        fail()
    assert inside == [1]
    assert numba.get_num_threads() == before
