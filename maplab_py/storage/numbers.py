"""Repeated numbers of messages as checked arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError

F64 = NDArray[np.float64]

_UNIT_TOLERANCE = 1e-4


def rows(fields: Sequence[Any], width: int, where: str) -> F64:
    """Stack repeated fields of `width` numbers each to (N, width).

    Raises:
        MapError: A field has another number of entries.
    """
    for index, field in enumerate(fields):
        if len(field) != width:
            raise MapError(f"{where} of entry {index} has {len(field)} numbers instead of {width}")
    return np.array(fields, dtype=np.float64).reshape(-1, width)


def rows_or(fields: Sequence[Any], width: int, fill: float, where: str) -> F64:
    """Stack repeated fields that may be absent: their rows are filled with `fill`."""
    result = np.full((len(fields), width), fill)
    present = [index for index, field in enumerate(fields) if len(field)]
    if present:
        result[present] = rows([fields[index] for index in present], width, where)
    return result


def finite(values: F64, where: str) -> F64:
    """Return the values, all of which must be numbers.

    Raises:
        MapError: One is not.
    """
    bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if len(bad):
        raise MapError(f"{where} of entry {int(bad[0])} is not a number")
    return values


def poses(fields: Sequence[Any], where: str) -> F64:
    """Stack poses (N, 7) [qx qy qz qw px py pz]; absent ones are the identity.

    Raises:
        MapError: One has a wrong count, is not a number, or its quaternion is not of unit length.
    """
    values = rows_or(fields, 7, 0.0, where)
    absent = [index for index, field in enumerate(fields) if not len(field)]
    values[absent, 3] = 1.0
    check_poses(values, where)
    return values


def check_poses(values: F64, where: str) -> None:
    """Check poses (N, 7).

    Raises:
        MapError: One is not a number, or its quaternion is not of unit length.
    """
    finite(values, where)
    length = np.linalg.norm(values[:, :4], axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > _UNIT_TOLERANCE)
    if len(bad):
        raise MapError(
            f"{where} of entry {int(bad[0])}: the quaternion has length {length[bad[0]]:.6g}, not 1"
        )


def covariances(fields: Sequence[Any], size: int, where: str) -> F64:
    """Stack covariances (N, size, size), NaN where absent."""
    return rows_or(fields, size * size, np.nan, where).reshape(-1, size, size)
