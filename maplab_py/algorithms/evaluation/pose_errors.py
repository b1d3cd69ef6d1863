"""Absolute and relative pose errors with evo's definitions (M. Grupp, evo, metrics.py).

Following Sturm et al., A benchmark for the evaluation of RGB-D SLAM systems, IROS 2012.
"""

import numpy as np

from maplab_py.algorithms.evaluation.options import ALIGNMENTS
from maplab_py.algorithms.evaluation.reports import ErrorStatistics
from maplab_py.array_types import F64, I64
from maplab_py.errors import EstimationError
from maplab_py.geometry import se3, so3
from maplab_py.geometry.alignment import align_yaw_position, apply_similarity, umeyama

ALL_PAIRS_TOLERANCE = 0.1
"""Relative tolerance of the length of a segment when all pairs are used, as in evo."""


def statistics(errors: F64) -> ErrorStatistics:
    """Summarise errors (N,), N > 0; std is that of the population."""
    return ErrorStatistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        std=float(np.std(errors)),
        min=float(np.min(errors)),
        max=float(np.max(errors)),
        count=len(errors),
    )


def align(T_R_B: F64, T_G_I: F64, alignment: str) -> tuple[F64, float]:
    """Return the estimate aligned with the reference (N, 7), and the scale.

    Args:
        T_R_B: Reference poses (N, 7).
        T_G_I: Estimated poses (N, 7), row by row of the same instants.
        alignment: se3, sim3, yaw (yaw and position) or none.

    Raises:
        EstimationError: Too few points, points on a line, or an unknown alignment.
    """
    if alignment not in ALIGNMENTS:
        raise EstimationError(f"alignment '{alignment}' is not one of {', '.join(ALIGNMENTS)}")
    if alignment == "none":
        return T_G_I, 1.0
    if alignment == "yaw":
        return se3.compose(align_yaw_position(T_R_B[:, 4:], T_G_I[:, 4:]), T_G_I), 1.0
    T_R_G, scale = umeyama(T_R_B[:, 4:], T_G_I[:, 4:], with_scale=alignment == "sim3")
    return apply_similarity(T_R_G, scale, T_G_I), scale


def absolute_errors(T_R_B: F64, T_R_I: F64) -> tuple[F64, F64]:
    """Return the distances (N,) [m] and rotation angles (N,) [deg] between poses (N, 7)."""
    distance = np.linalg.norm(T_R_I[:, 4:] - T_R_B[:, 4:], axis=1)
    return distance, _angle_deg(so3.multiply(so3.inverse(T_R_B[:, :4]), T_R_I[:, :4]))


def relative_errors(T_R_B: F64, T_R_I: F64, pairs: I64) -> tuple[F64, F64]:
    """Return the errors of the motion over pairs (P, 2) of rows: (P,) [m] and (P,) [deg]."""
    i, j = pairs[:, 0], pairs[:, 1]
    motion_B = se3.relative(T_R_B[i], T_R_B[j])
    motion_I = se3.relative(T_R_I[i], T_R_I[j])
    error = se3.relative(motion_B, motion_I)
    return np.linalg.norm(error[:, 4:], axis=1), _angle_deg(error[:, :4])


def pairs_by_frames(count: int, delta: int, *, all_pairs: bool) -> I64:
    """Return pairs (P, 2) of rows that are `delta` rows apart."""
    if delta < 1:
        raise EstimationError("a segment of the relative pose error must span at least one frame")
    rows = np.arange(0, count, 1 if all_pairs else delta, dtype=np.int64)
    rows = rows[rows + delta < count]
    return np.stack([rows, rows + delta], axis=1)


def pairs_by_length(steps: F64, delta: float, *, all_pairs: bool) -> I64:
    """Return pairs (P, 2) of rows with a distance of `delta` along the path.

    Consecutive segments end where their length first reaches delta. With all pairs, each row is
    paired with the later row whose distance along the path is nearest to delta, if it is within
    10 % of it.

    Args:
        steps: Length (N - 1,) of the step from each row to the next: metres or seconds, >= 0.
        delta: Wanted length in the same unit, > 0.
        all_pairs: Start a segment at every row.
    """
    if delta <= 0.0:
        raise EstimationError("the length of a segment of the relative pose error must be positive")
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    if not all_pairs:
        return _consecutive(steps, travelled, delta)
    rows = np.arange(len(travelled) - 1)
    after = np.searchsorted(travelled, travelled[:-1] + delta)
    after = np.clip(after, rows + 1, len(travelled) - 1)
    before = np.maximum(after - 1, rows + 1)
    error_after = np.abs(travelled[after] - travelled[:-1] - delta)
    error_before = np.abs(travelled[before] - travelled[:-1] - delta)
    ends = np.where(error_before <= error_after, before, after)
    # of rows at the same place the first one
    ends = np.maximum(np.searchsorted(travelled, travelled[ends]), rows + 1)
    kept = np.minimum(error_before, error_after) <= delta * ALL_PAIRS_TOLERANCE
    return np.stack([rows[kept], ends[kept]], axis=1).astype(np.int64)


def _consecutive(steps: F64, travelled: F64, delta: float) -> I64:
    """Split the path greedily; each segment is summed separately to avoid accumulated rounding."""
    cuts = [0]
    while True:
        begin = cuts[-1]
        guess = int(np.searchsorted(travelled, travelled[begin] + delta)) + 2
        lengths = np.cumsum(steps[begin:guess])
        reached = np.flatnonzero(lengths >= delta)
        if len(reached) == 0:
            break
        cuts.append(begin + int(reached[0]) + 1)
    return np.stack([cuts[:-1], cuts[1:]], axis=1).astype(np.int64)


def mean_rotation(q: F64) -> F64:
    """Return the quaternion (4,) nearest to all of q (N, 4).

    Source: Markley et al., Averaging quaternions, JGCD 2007, eq. (13).
    """
    mean = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.asarray(mean if mean[3] >= 0.0 else -mean)


def _angle_deg(q: F64) -> F64:
    return np.asarray(np.degrees(np.linalg.norm(so3.log(q), axis=-1)))
