"""Outliers among absolute positions, found before solving.

The difference between measured and estimated positions changes slowly, by the drift of the trajectory;
a measurement that differs from the local median of the differences is wrong. So a trajectory may
be tens of metres off while single measurements are judged by their own deviation.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, symmetric
from maplab_py.vimap import VIMap

_WINDOW = 31
"""Neighbouring measurements whose median counts; up to half of them may be wrong."""
_MIN_MEASUREMENTS = 5
_LEAST_VARIANCE_M2 = 1e-12
_MEDIAN_CHI = 1.538
"""Median of the norm of three standard normal variables."""


def absolute_outliers(vi_map: VIMap, rows: I64, T_I_S: F64, gate_sigma: float) -> Mask:
    """Return which absolute poses (rows of the table, N) have outlying positions (N,).

    Deviations count by the covariances, scaled up where most measurements are worse than these say.

    Args:
        vi_map: Map with the initial states.
        rows: Rows of `absolute_poses`.
        T_I_S: Extrinsics (N, 7) of their sensors.
        gate_sigma: Largest deviation of an inlier, in standard deviations; 0 = all are inliers.
    """
    result = np.zeros(len(rows), dtype=np.bool_)
    if gate_sigma <= 0.0 or not len(rows):
        return result
    table = vi_map.absolute_poses.take(rows)
    p_G = se3.compose(vi_map.T_G_I[table.vertex], T_I_S)[:, 4:]
    difference_m = table.T_G_S[:, 4:] - p_G
    mission = vi_map.vertices.mission[table.vertex].astype(np.uint64)
    keys = np.column_stack([mission, table.sensor_id])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    for number in range(int(group.max()) + 1):
        members = np.flatnonzero(group.reshape(-1) == number)
        members = members[np.argsort(table.timestamp_ns[members], kind="stable")]
        if len(members) >= _MIN_MEASUREMENTS:
            deviation = _deviations(difference_m[members], table.covariance[members, :3, :3])
            unit = max(1.0, float(np.median(deviation)) / _MEDIAN_CHI)
            result[members] = deviation > gate_sigma * unit
    return result


def _deviations(difference_m: F64, covariance: F64) -> F64:
    """Return the deviations (N,) from the local median, in standard deviations."""
    from scipy.ndimage import median_filter

    window = min(_WINDOW, len(difference_m) - 1 + len(difference_m) % 2)
    # mirrored, the first and the last measurement count once among their neighbours
    away = difference_m - median_filter(difference_m, size=(window, 1), mode="mirror")
    usable = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    information = symmetric.inverse(np.where(usable, covariance, np.eye(3)), _LEAST_VARIANCE_M2)
    squared = np.einsum("ni,nij,nj->n", away, information, away)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))
