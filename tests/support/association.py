"""Association of the time stamps of two recordings, as evo does it."""

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import I64
from maplab_py.geometry.interpolation import nearest_rows


def associate(
    times_a_ns: ArrayLike,
    times_b_ns: ArrayLike,
    max_difference_ns: int,
    *,
    one_to_one: bool = True,
) -> tuple[I64, I64]:
    """Return the index pairs (rows of a, rows of b) of time stamps that belong together.

    Every stamp of the shorter list (of b when they are equally long) takes its nearest stamp of
    the longer one, if that is at most `max_difference_ns` away; the earlier of two equally near.
    This is evo's definition (`sync.associate_trajectories`), in which one stamp of the longer list
    may serve twice; with `one_to_one` only its nearest partner keeps it.

    Args:
        times_a_ns: Time stamps (N,), sorted.
        times_b_ns: Time stamps (M,), sorted.
        max_difference_ns: Largest difference, included.
        one_to_one: Use no stamp twice.
    """
    a, b = np.asarray(times_a_ns, dtype=np.int64), np.asarray(times_b_ns, dtype=np.int64)
    b_is_longer = len(b) > len(a)
    short, long = (a, b) if b_is_longer else (b, a)
    if len(short) == 0:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    nearest = nearest_rows(long, short)
    difference = np.abs(long[nearest] - short)
    rows = np.flatnonzero(difference <= max_difference_ns)
    if one_to_one:
        rows = rows[np.lexsort((rows, difference[rows], nearest[rows]))]
        _, first = np.unique(nearest[rows], return_index=True)
        rows = np.sort(rows[first])
    return (rows, nearest[rows]) if b_is_longer else (nearest[rows], rows)
