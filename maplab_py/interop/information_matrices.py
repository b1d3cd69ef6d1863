"""Information matrices of files: printed with few digits they may lose their positive definiteness."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64

_SMALLEST_RATIO = 1e-9
"""Smallest eigenvalue of a repaired matrix over the largest: the direction then tells almost nothing."""


def positive_definite(information: F64) -> tuple[F64, int]:
    """Raise the eigenvalues of matrices (N, 6, 6) that are not positive definite.

    Matrices that have a Cholesky factor are returned bit for bit. In the others eigenvalues below
    1e-9 of the largest are raised to that; a matrix without a positive eigenvalue, or with entries
    that are not finite, cannot be repaired and stays.

    Returns:
        The matrices, and how many of them were changed.
    """
    finite = np.isfinite(information).all(axis=(1, 2))
    suspects = np.flatnonzero(finite)
    value = np.linalg.eigvalsh(information[suspects])
    # what is safely positive needs no further look
    suspects = suspects[value[:, 0] <= _SMALLEST_RATIO * np.maximum(value[:, -1], 0.0)]
    rows = np.array([row for row in suspects.tolist() if not _has_factor(information[row])], int)
    value, vector = np.linalg.eigh(information[rows])
    can_repair = value[:, -1] > 0.0
    rows, value, vector = rows[can_repair], value[can_repair], vector[can_repair]
    value = np.maximum(value, _SMALLEST_RATIO * value[:, -1:])
    result = information.copy()
    result[rows] = (vector * value[:, None, :]) @ np.swapaxes(vector, 1, 2)
    result[rows] = 0.5 * (result[rows] + np.swapaxes(result[rows], 1, 2))
    return result, len(rows)


def _has_factor(matrix: F64) -> bool:
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
