"""Eigenvalues, inverses and square roots of many small symmetric matrices.

They are compiled loops instead of LAPACK for two reasons. Input that is singular, huge or no number
gets an answer instead of an exception: a direction without information is as uncertain as the caller
says. And the bits of a result do not depend on the processor, as those of a BLAS library do.

Source: Golub and Van Loan, Matrix Computations, 4th ed., algorithms 8.5.2 (cyclic Jacobi) and 4.2.1
(Cholesky).
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, Mask
from maplab_py.compilation import compiled

_EPSILON = float(np.finfo(np.float64).eps)
_MAX_SWEEPS = 30
"""Jacobi converges quadratically: six sweeps are usual for six rows."""


def eigen(matrices: ArrayLike) -> tuple[F64, F64]:
    """Return the eigenvalues (N, n), ascending, and eigenvectors (N, n, n) as columns.

    Only the mean of a matrix and its transpose counts. A matrix with an entry that is not finite has
    eigenvalues NaN and unit vectors.

    Args:
        matrices: (N, n, n).
    """
    A = np.ascontiguousarray(matrices, dtype=np.float64)
    values, vectors = np.empty(A.shape[:2]), np.empty_like(A)
    _decompose(A, values, vectors)
    return values, vectors


def inverse(matrices: ArrayLike, least: float = 0.0) -> F64:
    """Return the inverses (N, n, n) of positive semidefinite matrices.

    Eigenvalues that are below `least`, or lost in the rounding error of the largest, count as `least`: an
    information matrix keeps at most the variance 1 / least in each direction, infinite for zero. Matrices
    with entries that are not finite give NaN.

    Args:
        matrices: (N, n, n).
        least: Smallest eigenvalue that the matrices can have.
    """
    A = np.ascontiguousarray(matrices, dtype=np.float64)
    result = np.empty_like(A)
    _invert(A, least, result)
    return result


def is_positive_definite(matrices: ArrayLike) -> Mask:
    """Return which matrices (N, n, n) have eigenvalues above the rounding error of the largest."""
    values, _ = eigen(matrices)
    least = values.shape[1] * _EPSILON * np.maximum(values[:, -1], 0.0)
    return np.asarray(values[:, 0] > least)


def whitening(covariances: ArrayLike, least: float) -> F64:
    """Return W (N, n, n) with W^T W = covariance^-1, eigenvalues raised to at least `least`.

    Args:
        covariances: (N, n, n).
        least: Smallest variance in any direction, positive.
    """
    values, vectors = eigen(covariances)
    scale = 1.0 / np.sqrt(np.maximum(values, least))
    return np.asarray(scale[:, :, None] * vectors.transpose(0, 2, 1))


def lower_whitening(covariances: ArrayLike) -> F64:
    """Return L^-1 (N, n, n), lower triangular, with L L^T the covariance.

    A pivot below the rounding error of its diagonal entry is raised to it, so that every covariance has a
    factor. Entries that are not finite give NaN.

    Args:
        covariances: (N, n, n) with a positive diagonal; the lower triangles count.
    """
    A = np.ascontiguousarray(covariances, dtype=np.float64)
    result = np.zeros_like(A)
    _invert_factor(A, result)
    return result


@compiled()
def _decompose(A, values, vectors):  # type: ignore[no-untyped-def]
    """Write eigenvalues (N, n) and eigenvectors (N, n, n) of matrices (N, n, n)."""
    n = A.shape[1]
    work = np.empty((n, n))
    for row in range(len(A)):
        largest = _symmetrize(A[row], work)
        V = vectors[row]
        for i in range(n):
            for j in range(n):
                V[i, j] = 1.0 if i == j else 0.0
        if not math.isfinite(largest):
            for i in range(n):
                values[row, i] = np.nan
            continue
        _diagonalize(work, V)
        for i in range(n):
            values[row, i] = work[i, i] * largest
        _sort(values[row], V)


@compiled()
def _symmetrize(matrix, work):  # type: ignore[no-untyped-def]
    """Write the symmetric part, divided by its largest entry; return that, infinite if one is no number."""
    n = len(matrix)
    largest = 0.0
    for i in range(n):
        for j in range(n):
            value = 0.5 * matrix[i, j] + 0.5 * matrix[j, i]
            if not math.isfinite(value):
                return np.inf
            work[i, j] = value
            largest = max(largest, abs(value))
    if largest > 0.0:
        for i in range(n):
            for j in range(n):
                work[i, j] /= largest
    return largest


@compiled()
def _diagonalize(A, V):  # type: ignore[no-untyped-def]
    """Rotate A (n, n) to diagonal form by cyclic Jacobi sweeps; V collects the rotations."""
    n = len(A)
    for _ in range(_MAX_SWEEPS):
        is_diagonal = True
        for p in range(n - 1):
            for q in range(p + 1, n):
                # relative to its diagonal entries: small eigenvalues keep their digits
                if abs(A[p, q]) <= _EPSILON * math.sqrt(abs(A[p, p] * A[q, q])):
                    A[p, q] = A[q, p] = 0.0
                    continue
                is_diagonal = False
                _rotate(A, V, p, q)
        if is_diagonal:
            return


@compiled()
def _rotate(A, V, p, q):  # type: ignore[no-untyped-def]
    """Annihilate A[p, q] by a rotation in the plane of p and q."""
    half_difference = 0.5 * (A[q, q] - A[p, p])
    off = A[p, q]
    if abs(off) <= _EPSILON * _EPSILON * abs(half_difference):
        t = 0.5 * off / half_difference
    else:
        tau = half_difference / off
        t = 1.0 / (abs(tau) + math.sqrt(1.0 + tau * tau))
        if tau < 0.0:
            t = -t
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = t * c
    A[p, p] -= t * off
    A[q, q] += t * off
    A[p, q] = A[q, p] = 0.0
    for k in range(len(A)):
        if k not in (p, q):
            x, y = A[k, p], A[k, q]
            A[k, p] = A[p, k] = c * x - s * y
            A[k, q] = A[q, k] = s * x + c * y
        x, y = V[k, p], V[k, q]
        V[k, p] = c * x - s * y
        V[k, q] = s * x + c * y


@compiled()
def _sort(values, V):  # type: ignore[no-untyped-def]
    """Order eigenvalues (n,) and their columns of V (n, n) from the smallest to the largest."""
    n = len(values)
    for i in range(n - 1):
        least = i
        for j in range(i + 1, n):
            if values[j] < values[least]:
                least = j
        if least != i:
            values[i], values[least] = values[least], values[i]
            for k in range(n):
                V[k, i], V[k, least] = V[k, least], V[k, i]


@compiled()
def _invert(A, least, result):  # type: ignore[no-untyped-def]
    """Write V diag(1 / max(eigenvalue, least)) V^T (N, n, n)."""
    count, n = A.shape[0], A.shape[1]
    values, vectors = np.empty((count, n)), np.empty((count, n, n))
    _decompose(A, values, vectors)
    for row in range(count):
        V, value = vectors[row], values[row]
        rounding = n * _EPSILON * value[n - 1]
        for k in range(n):
            if value[k] < least or value[k] <= rounding:
                value[k] = least
        for i in range(n):
            for j in range(i + 1):
                total = 0.0 if value[0] == value[0] else np.nan
                for k in range(n):
                    product = V[i, k] * V[j, k]
                    if product != 0.0:  # else 0 / 0 where nothing is known
                        total += product / value[k]
                result[row, i, j] = result[row, j, i] = total


@compiled()
def _invert_factor(A, result):  # type: ignore[no-untyped-def]
    """Write the inverses of the Cholesky factors (N, n, n), lower triangular."""
    n = A.shape[1]
    L = np.zeros((n, n))
    for row in range(len(A)):
        X = result[row]
        for j in range(n):
            pivot = A[row, j, j]
            floor = _EPSILON * pivot
            for k in range(j):
                pivot -= L[j, k] * L[j, k]
            L[j, j] = math.sqrt(floor if pivot < floor else pivot)
            for i in range(j + 1, n):
                value = A[row, i, j]
                for k in range(j):
                    value -= L[i, k] * L[j, k]
                L[i, j] = value / L[j, j]
        for j in range(n):
            X[j, j] = 1.0 / L[j, j]
            for i in range(j + 1, n):
                value = 0.0
                for k in range(j, i):
                    value -= L[i, k] * X[k, j]
                X[i, j] = value / L[i, i]
