"""Interpolation of poses and vectors between time stamps."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import EstimationError
from maplab_py.geometry import so3


def slerp(q_A_B: ArrayLike, q_A_C: ArrayLike, fraction: ArrayLike) -> F64:
    """Return quaternions (..., 4) on the shorter arc, at fractions (...,) of it."""
    start = np.asarray(q_A_B, dtype=np.float64)
    arc = so3.log(so3.multiply(so3.inverse(start), q_A_C))
    step = so3.exp(np.asarray(fraction, dtype=np.float64)[..., None] * arc)
    return so3.normalize(so3.multiply(start, step))


def interpolate_poses(
    times_ns: ArrayLike, T_A_B: ArrayLike, query_ns: ArrayLike, *, max_gap_ns: int = 0
) -> tuple[F64, Mask]:
    """Return the poses (Q, 7) at the queried times and whether they are valid (Q,).

    Rotations are interpolated along the great arc, positions linearly. A query outside the span
    of the stamps is not valid and gets the pose of the nearest end.

    Args:
        times_ns: Time stamps (N,), strictly increasing, N > 0.
        T_A_B: Poses (N, 7) at these times.
        query_ns: Queried times (Q,) in any order.
        max_gap_ns: Queries between stamps that are further apart are not valid; 0 = no limit.

    Raises:
        EstimationError: There is no pose or the stamps do not increase.
    """
    T = np.asarray(T_A_B, dtype=np.float64)
    before, after, fraction, valid = _brackets(times_ns, query_ns, max_gap_ns)
    q = slerp(T[before, :4], T[after, :4], fraction)
    p = T[before, 4:] + fraction[:, None] * (T[after, 4:] - T[before, 4:])
    return np.concatenate([q, p], axis=1), valid


def interpolate_vectors(
    times_ns: ArrayLike, values: ArrayLike, query_ns: ArrayLike, *, max_gap_ns: int = 0
) -> tuple[F64, Mask]:
    """Interpolate rows (N, ...) linearly; arguments and result as in `interpolate_poses`."""
    rows = np.asarray(values, dtype=np.float64)
    before, after, fraction, valid = _brackets(times_ns, query_ns, max_gap_ns)
    weight = fraction.reshape(-1, *(1,) * (rows.ndim - 1))
    return rows[before] + weight * (rows[after] - rows[before]), valid


def _brackets(
    times_ns: ArrayLike, query_ns: ArrayLike, max_gap_ns: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], F64, Mask]:
    """Return rows before and after each query, the fraction between them, and validity."""
    times, query = np.asarray(times_ns, dtype=np.int64), np.asarray(query_ns, dtype=np.int64)
    if len(times) == 0:
        raise EstimationError("cannot interpolate: there are no time stamps")
    if np.any(times[1:] <= times[:-1]):
        row = int(np.flatnonzero(times[1:] <= times[:-1])[0])
        raise EstimationError(
            f"cannot interpolate: time stamp {times[row + 1]} does not come after {times[row]}"
        )
    after = np.clip(np.searchsorted(times, query), 1, max(len(times) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    gap = times[after] - times[before]
    offset = np.clip(query - times[before], 0, gap)
    fraction = offset / np.maximum(gap, 1)
    valid = (query >= times[0]) & (query <= times[-1])
    if max_gap_ns > 0:
        at_stamp = (offset == 0) | (offset == gap)
        valid &= (gap <= max_gap_ns) | at_stamp
    return before, after, np.asarray(fraction, dtype=np.float64), valid


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
