"""Other readings of a trajectory that fit a map better: orders of quaternions, and clocks.

Both are found by trying them; nothing is changed, a hint names the reading and the error that it would have.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from maplab_py.algorithms.evaluation.pose_errors import mean_rotation
from maplab_py.array_types import F64, I64
from maplab_py.geometry import so3
from maplab_py.geometry.interpolation import interpolate_poses

_CLEARLY = 0.2
"""A reading is named when it leaves at most this share of the median angle."""
_LARGEST_DEG = 15.0
"""Median angle that a right reading has at most."""
_GRID_NS = 50_000_000
_MOTION_STEPS = 4
"""Motion is measured over 0.2 s: shorter steps are noise, longer ones have no detail."""
_MOST_STEPS = 1 << 18
_LEAST_OVERLAP = 0.3
_LEAST_SECONDS = 3.0
_LONGEST_GAP_NS = 1_000_000_000
_GOLDEN = 0.6180339887498949


class Reading(NamedTuple):
    """Another way to read a quaternion."""

    name: str
    apply: Callable[[F64], F64]


_READINGS = (
    Reading("qw first", lambda q: np.roll(q, -1, axis=1)),
    Reading("qw last", lambda q: np.roll(q, 1, axis=1)),
    Reading("inverted rotations", so3.inverse),
    Reading("qw first and inverted rotations", lambda q: so3.inverse(np.roll(q, -1, axis=1))),
    Reading("qw last and inverted rotations", lambda q: so3.inverse(np.roll(q, 1, axis=1))),
)


def orientation_hint(q_R_B: F64, q_R_I: F64, *, is_mounted: bool = False) -> str:
    """Return a clause on the order of quaternions that fits clearly better, empty when none does.

    Args:
        q_R_B: Quaternions (N, 4) of a file.
        q_R_I: Quaternions (N, 4) of the same instants, in the same frame.
        is_mounted: The bodies are the same; else they may differ by a constant rotation.
    """
    return _best_reading(q_R_B, q_R_I, lambda q: q, 1 if is_mounted else 2)


def motion_hint(q_R_S: F64, q_M_S: F64) -> tuple[float, str]:
    """Return the median difference [deg] of rotations over a quarter of a path, and a clause on their order.

    Args:
        q_R_S: Quaternions (N, 4) of a file, N > 1.
        q_M_S: Those of the same sensor and instants in any other frame (N, 4).
    """
    ahead = max(len(q_R_S) // 4, 1)

    def turns(q: F64) -> F64:
        return so3.multiply(so3.inverse(q[:-ahead]), q[ahead:])

    before = _angles_deg(turns(q_R_S), turns(q_M_S))[0]
    return before, _best_reading(q_R_S, q_M_S, turns, 1)


def _best_reading(q_file: F64, q_map: F64, compared: Callable[[F64], F64], kinds: int) -> str:
    """Return a clause on the reading with the least angle, if it is clearly below that of the file."""
    there = compared(q_map)
    before = _angles_deg(compared(q_file), there)
    best, hint = np.inf, ""
    for reading in _READINGS:
        after = _angles_deg(compared(reading.apply(q_file)), there)
        for k, kind in enumerate(("", " beside a constant rotation")[:kinds]):
            if after[k] < min(_LARGEST_DEG, _CLEARLY * before[k], _CLEARLY * best):
                best = after[k]
                hint = (
                    f"the orientations differ by {before[k]:.4g} deg{kind}, {reading.name} would give "
                    f"{after[k]:.2g} deg: name the columns in a header (# timestamp tx ty tz qw ...)"
                )
    return hint


def _angles_deg(q_R_B: F64, q_R_I: F64) -> tuple[float, float]:
    """Return the median angle, and that without a constant rotation between the bodies."""
    q_B_I = so3.multiply(so3.inverse(q_R_B), q_R_I)
    rest = so3.multiply(so3.inverse(mean_rotation(q_B_I)), q_B_I)
    plain, spread = (np.median(np.linalg.norm(so3.log(q), axis=1)) for q in (q_B_I, rest))
    return float(np.degrees(plain)), float(np.degrees(spread))


def clock_offset_ns(
    times_A: I64,
    T_A: F64,
    times_B: I64,
    T_B: F64,
    error_at: Callable[[int], float],
    *,
    has_orientation: bool = True,
) -> tuple[int, float] | None:
    """Return the offset [ns] that, added to the stamps of A, fits its motion to that of B, and its error.

    The speeds of turning and of moving, which no frame changes, are correlated over all offsets; the best
    is refined by the error itself.

    Args:
        times_A: Stamps (N,), ascending.
        T_A: Poses (N, 7).
        times_B: Stamps (M,), ascending.
        T_B: Poses (M, 7).
        error_at: Error of an offset, infinite where there is nothing to compare.
        has_orientation: Whether A has orientations.
    """
    span_ns = max(int(t[-1] - t[0]) for t in (times_A, times_B))
    step_ns = max(_GRID_NS, span_ns // _MOST_STEPS)
    a, b = (_speeds(t, T, step_ns) for t, T in ((times_A, T_A), (times_B, T_B)))
    best: tuple[float, int] | None = None
    for kind in (0, 1) if has_orientation else (0,):
        lag = _lag(a[kind], b[kind], step_ns)
        if lag is None:
            continue
        coarse = int(times_B[0]) - int(times_A[0]) + lag * step_ns
        refined = _minimum(error_at, coarse - 2 * step_ns, coarse + 2 * step_ns)
        best = refined if best is None else min(best, refined)
    return None if best is None or not np.isfinite(best[0]) else (best[1], best[0])


def _speeds(times_ns: I64, T: F64, step_ns: int) -> tuple[F64, F64]:
    """Return the motion of each grid step [m], [rad] from the first stamp on, NaN in gaps."""
    grid = np.arange(times_ns[0], times_ns[-1], step_ns, dtype=np.int64)
    usual = 3 * int(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 0
    poses, is_there = interpolate_poses(times_ns, T, grid, max_gap_ns=max(_LONGEST_GAP_NS, usual))
    before, after = poses[:-_MOTION_STEPS], poses[_MOTION_STEPS:]
    moved = np.linalg.norm(after[:, 4:] - before[:, 4:], axis=1)
    turned = np.linalg.norm(so3.log(so3.multiply(so3.inverse(before[:, :4]), after[:, :4])), axis=1)
    gap = ~(is_there[:-_MOTION_STEPS] & is_there[_MOTION_STEPS:])
    moved[gap] = turned[gap] = np.nan
    return moved, turned


def _lag(a: F64, b: F64, step_ns: int) -> int | None:
    """Return the number of steps by which `a` starts after `b`, by normalised correlation."""
    from scipy.signal import correlate

    masks = [np.isfinite(x).astype(np.float64) for x in (a, b)]
    least = max(_LEAST_OVERLAP * min(m.sum() for m in masks), _LEAST_SECONDS * 1e9 / step_ns)
    if min(m.sum() for m in masks) < least or not len(a) or not len(b):
        return None
    a, b = (np.where(m > 0, x - np.mean(x[m > 0]), 0.0) for x, m in zip((a, b), masks, strict=True))
    overlap = correlate(masks[1], masks[0], method="fft")
    energy_a = correlate(masks[1], a * a, method="fft")
    energy_b = correlate(b * b, masks[0], method="fft")
    least_energy = 1e-6 * max(float(np.sum(a * a)), float(np.sum(b * b)))
    enough = (overlap >= least - 0.5) & (np.minimum(energy_a, energy_b) > least_energy)
    if not enough.any():
        return None
    norm = np.sqrt(np.where(enough, energy_a * energy_b, 1.0))
    # of equal scores the one with more in common
    weight = np.sqrt(np.where(enough, overlap, 0.0)) / norm
    score = np.where(enough, correlate(b, a, method="fft") * weight, -np.inf)
    return int(np.argmax(score)) - (len(a) - 1)


def _minimum(error_at: Callable[[int], float], low: int, high: int) -> tuple[float, int]:
    """Return the least error and its offset, by golden-section search down to 0.1 ms."""
    tried: list[tuple[float, int]] = []

    def value(offset: int) -> float:
        tried.append((error_at(offset), offset))
        return tried[-1][0]

    left, right = (round(high - _GOLDEN * (high - low)), round(low + _GOLDEN * (high - low)))
    at_left, at_right = value(left), value(right)
    while high - low > 100_000:
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = round(high - _GOLDEN * (high - low))
            at_left = value(left)
        else:
            low, left, at_left = left, right, at_right
            right = round(low + _GOLDEN * (high - low))
            at_right = value(right)
    return min(tried)
