from __future__ import annotations

from threadpoolctl import threadpool_info

from maplab_py.estimation.linear.threads import single_blas_thread


def blas_threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


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
