"""BLAS and LAPACK routines of scipy as functions that numba code can call.

scipy exports the addresses of its bundled Fortran-style routines for Cython; numba can call any
address through an external symbol. All arguments are pointers, matrices are column-major, integers
are 32 bit. Matrices whose leading dimension is larger than their height are parts of larger ones.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm

from maplab_py.compilation import numba

types = numba.types

_CHAR = types.CPointer(types.int8)
_INT = types.CPointer(types.int32)
_REAL = types.CPointer(types.float64)


def _routine(module: str, name: str, *arguments: Any) -> Any:
    symbol = "maplab_py_" + name
    llvm.add_symbol(
        symbol, numba.extending.get_cython_function_address("scipy.linalg." + module, name)
    )
    return types.ExternalFunction(symbol, types.void(*arguments))


# potrf(uplo, n, A, lda, info): A = L L^T in place
dpotrf = _routine("cython_lapack", "dpotrf", _CHAR, _INT, _REAL, _INT, _INT)

# trsm(side, uplo, trans, diag, m, n, alpha, A, lda, B, ldb): B (m, n) = alpha op(A)^-1 B, or from the right
dtrsm = _routine("cython_blas", "dtrsm", *[_CHAR] * 4, _INT, _INT, _REAL, _REAL, _INT, _REAL, _INT)

# syrk(uplo, trans, n, k, alpha, A, lda, beta, C, ldc): C (n, n) = alpha A A^T + beta C, A (n, k)
dsyrk = _routine(
    "cython_blas", "dsyrk", _CHAR, _CHAR, _INT, _INT, _REAL, _REAL, _INT, _REAL, _REAL, _INT
)

# gemm(transA, transB, m, n, k, alpha, A, lda, B, ldb, beta, C, ldc): C (m, n) = alpha op(A) op(B) + beta C
dgemm = _routine(
    "cython_blas",
    "dgemm",
    *[_CHAR] * 2,
    *[_INT] * 3,
    *[_REAL, _REAL, _INT, _REAL, _INT],
    *[_REAL, _REAL, _INT],
)
