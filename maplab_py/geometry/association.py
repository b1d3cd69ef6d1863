"""Nearest time stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import I64


def nearest_rows(times_ns: ArrayLike, query_ns: ArrayLike) -> I64:
    """Return the row (Q,) of the time stamp nearest to each query, the earlier of two equally near.

    Args:
        times_ns: Time stamps (N,), sorted, N > 0.
        query_ns: Time stamps (Q,) in any order.
    """
    times, query = np.asarray(times_ns, dtype=np.int64), np.asarray(query_ns, dtype=np.int64)
    after = np.clip(np.searchsorted(times, query), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    is_before = np.abs(query - times[before]) <= np.abs(times[after] - query)
    return np.asarray(np.where(is_before, before, after), dtype=np.int64)
