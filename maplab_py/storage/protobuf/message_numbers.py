"""Convert repeated numeric fields of messages to checked arrays.

`where` is the field and `name` gives file, kind and id of an entry, for the message of an error.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError
from maplab_py.vimap.consistency import LOADED_UNIT_TOLERANCE

Name = Callable[[int], str]

_ACCEPTS_ALL: ContextVar[bool] = ContextVar("accepts all", default=False)


@contextlib.contextmanager
def accept_bad_numbers() -> Iterator[None]:
    """Accept entries that are no numbers meanwhile; `number_repair` has to remove them."""
    token = _ACCEPTS_ALL.set(True)
    try:
        yield
    finally:
        _ACCEPTS_ALL.reset(token)


def rows(fields: Sequence[Any], width: int, where: str, name: Name) -> F64:
    """Stack repeated fields of `width` numbers each to (N, width).

    Raises:
        MapError: A field has another number of entries.
    """
    for index, field in enumerate(fields):
        if len(field) != width:
            raise MapError(f"{name(index)}: {where} has {len(field)} numbers instead of {width}")
    return np.array(fields, dtype=np.float64).reshape(-1, width)


def rows_or(fields: Sequence[Any], width: int, fill: float, where: str, name: Name) -> F64:
    """Stack repeated fields that may be absent: their rows are filled with `fill`."""
    result = np.full((len(fields), width), fill)
    present = [index for index, field in enumerate(fields) if len(field)]
    if present:
        present_fields = [fields[index] for index in present]
        result[present] = rows(present_fields, width, where, lambda index: name(present[index]))
    return result


def finite(values: F64, where: str, name: Name) -> F64:
    """Return the values after checking that all are finite.

    Raises:
        MapError: A value is not finite.
    """
    bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
    if len(bad) and not _ACCEPTS_ALL.get():
        raise MapError(
            f"{name(int(bad[0]))}: {where} has an entry that is not a number; load with --repair to drop it"
        )
    return values


def poses(fields: Sequence[Any], where: str, name: Name) -> F64:
    """Stack poses (N, 7) [qx qy qz qw px py pz]; absent ones are the identity.

    Raises:
        MapError: A pose has a wrong size, a value that is not finite, or no unit quaternion.
    """
    values = rows_or(fields, 7, 0.0, where, name)
    absent = [index for index, field in enumerate(fields) if not len(field)]
    values[absent, 3] = 1.0
    check_poses(values, where, name)
    return values


def check_poses(values: F64, where: str, name: Name) -> None:
    """Check poses (N, 7).

    Raises:
        MapError: A pose has a value that is not finite, or no unit quaternion.
    """
    finite(values, where, name)
    length = np.hypot.reduce(values[:, :4], axis=1)  # squares may overflow
    bad = np.flatnonzero(np.abs(length - 1.0) > LOADED_UNIT_TOLERANCE)
    if len(bad) and not _ACCEPTS_ALL.get():
        raise MapError(
            f"{name(int(bad[0]))}: the quaternion of {where} has length {length[bad[0]]:.6g}, not 1"
        )


def choices(values: Sequence[int], count: int, where: str, name: Name) -> list[int]:
    """Return values of an enumeration with values 0 .. count - 1.

    Raises:
        MapError: A value is unknown.
    """
    for index, value in enumerate(values):
        if not 0 <= value < count:
            raise MapError(f"{name(index)}: {where} is {value}; 0 to {count - 1} are known")
    return list(values)


def covariances(fields: Sequence[Any], size: int, where: str, name: Name) -> F64:
    """Stack covariances (N, size, size), NaN where absent."""
    return rows_or(fields, size * size, np.nan, where, name).reshape(-1, size, size)
