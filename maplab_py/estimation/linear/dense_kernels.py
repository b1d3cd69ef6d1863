"""Dense matrices inside flat arrays: the BLAS and LAPACK calls of the sparse factorisation.

Matrices are column-major as BLAS wants them, and every matrix comes with its leading dimension.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numpy as np

from maplab_py.array_types import F64, NDArray
from maplab_py.compilation import compiled, numba
from maplab_py.estimation.linear.scipy_extensions import scipy_extension

# scipy exports the addresses of its bundled Fortran-style routines for Cython; numba can call any
# address through an external symbol. All arguments are pointers, matrices are column-major, integers
# are 32 bit. Matrices whose leading dimension is larger than their height are parts of larger ones.

types = numba.types

_CHAR = types.CPointer(types.int8)
_INT = types.CPointer(types.int32)
_REAL = types.CPointer(types.float64)


def _routine(module: str, name: str, *arguments: Any) -> Any:
    symbol, full_name = "maplab_py_" + name, scipy_extension(f"linalg.{module}").__name__
    llvm.add_symbol(symbol, numba.extending.get_cython_function_address(full_name, name))
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


LEFT, RIGHT = 0, 1  # places in Blas.letters
PLAIN, TRANSPOSED = 2, 3
ONE, MINUS_ONE, ZERO = 0, 1, 2  # places in Blas.factors


class Blas(NamedTuple):
    """Letters, factors and sizes, which BLAS takes by address."""

    letters: NDArray[np.int8]
    factors: F64
    sizes: NDArray[np.int32]

    @classmethod
    def workspace(cls) -> Blas:
        """Make what the wrappers below need; not to be shared between threads."""
        letters = np.frombuffer(b"LRNT", dtype=np.int8).copy()
        return cls(letters, np.array([1.0, -1.0, 0.0]), np.zeros(8, dtype=np.int32))


class Matrix(NamedTuple):
    """A column-major matrix in a flat array."""

    values: F64
    leading: int  # numbers from one column to the next


@compiled()
def cholesky(blas: Blas, matrix: F64, order: int, leading: int) -> int:
    """Factorise the leading square of `matrix` in place; return 0 or the bad column plus one."""
    sizes = blas.sizes
    sizes[0], sizes[1], sizes[2] = order, leading, 0
    lower = blas.letters[LEFT:]  # the same letter L
    dpotrf(lower.ctypes, sizes[0:].ctypes, matrix.ctypes, sizes[1:].ctypes, sizes[2:].ctypes)
    bad_column = int(sizes[2])
    for column in range(order if bad_column == 0 else 0):  # OpenBLAS lets NaN pass
        if not 0.0 < matrix[column * leading + column] < np.inf:
            return column + 1
    return bad_column


@compiled()
def solve_triangle(
    blas: Blas,
    side: int,
    form: int,
    triangle: F64,
    leading: int,
    right: F64,
    rows: int,
    cols: int,
    right_leading: int,
) -> None:
    """Overwrite right (rows, cols) by op(triangle)^-1 right (LEFT) or right op(triangle)^-1.

    The triangle is lower; `form` PLAIN or TRANSPOSED says what op is.
    """
    letters, sizes = blas.letters, blas.sizes
    sizes[0], sizes[1], sizes[2], sizes[3] = rows, cols, leading, right_leading
    dtrsm(
        letters[side:].ctypes,
        letters[LEFT:].ctypes,
        letters[form:].ctypes,
        letters[PLAIN:].ctypes,  # N: the diagonal is not all ones
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        blas.factors[ONE:].ctypes,
        triangle.ctypes,
        sizes[2:].ctypes,
        right.ctypes,
        sizes[3:].ctypes,
    )


@compiled()
def square(blas: Blas, factor: F64, leading: int, rows: int, cols: int, result: F64) -> None:
    """Overwrite the lower triangle of result (rows, rows) by factor factor^T, factor (rows, cols)."""
    letters, sizes = blas.letters, blas.sizes
    sizes[0], sizes[1], sizes[2], sizes[3] = rows, cols, leading, rows
    dsyrk(
        letters[LEFT:].ctypes,
        letters[PLAIN:].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        blas.factors[ONE:].ctypes,
        factor.ctypes,
        sizes[2:].ctypes,
        blas.factors[ZERO:].ctypes,
        result.ctypes,
        sizes[3:].ctypes,
    )


@compiled()
def multiply(
    blas: Blas,
    shape: tuple[int, int, int],
    forms: tuple[int, int],
    a: Matrix,
    b: Matrix,
    factors: tuple[int, int],
    c: Matrix,
) -> None:
    """Overwrite c by f0 op(a) op(b) + f1 c; shape = rows of c, columns of c, inner size.

    `forms` says what op is for a and b; `factors` are the places of f0 and f1 in Blas.factors.
    """
    letters, sizes = blas.letters, blas.sizes
    sizes[0], sizes[1], sizes[2] = shape
    sizes[3], sizes[4], sizes[5] = a.leading, b.leading, c.leading
    dgemm(
        letters[forms[0] :].ctypes,
        letters[forms[1] :].ctypes,
        sizes[0:].ctypes,
        sizes[1:].ctypes,
        sizes[2:].ctypes,
        blas.factors[factors[0] :].ctypes,
        a.values.ctypes,
        sizes[3:].ctypes,
        b.values.ctypes,
        sizes[4:].ctypes,
        blas.factors[factors[1] :].ctypes,
        c.values.ctypes,
        sizes[5:].ctypes,
    )
