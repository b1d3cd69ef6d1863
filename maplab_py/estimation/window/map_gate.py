"""Test of associations with a map against the observations of their tracks.

A track may leave its point for another one, before or after it was matched with a landmark of the map:
then a single observation can be off by hundreds of pixels. The Huber loss bounds the residual of such an
observation, but not its Jacobian, which grows without bound near the plane of the camera.
"""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, Mask
from maplab_py.estimation.window.map_terms import MapObservations
from maplab_py.estimation.window.options import WindowOptions

MAP_GATE_CHI2 = 13.8
"""Largest squared error of an observation of the map in standard deviations (99.9 %).

It is wider than the odometry's gate: an observation that is refused takes the association of a whole track
with it, and landmarks of the map have errors of their own.
"""


def contradicted(error_px: F64, seen: MapObservations, options: WindowOptions) -> Mask:
    """Tell which landmarks (A,) have an observation far from where it is expected.

    Args:
        error_px: Reprojection errors (O,) at predicted poses; infinite where a landmark is not visible.
        seen: The observations.
        options: Uncertainty of a predicted place, as for landmarks of the odometry.
    """
    if not len(seen):
        return np.zeros(len(seen.start) - 1, dtype=np.bool_)
    sigma2 = seen.sigma_px**2 + options.prediction_sigma_px**2
    far = ~(error_px**2 <= MAP_GATE_CHI2 * sigma2)
    return np.asarray(np.logical_or.reduceat(far, seen.start[:-1]))


def contradicted_unless_most(
    error_px: F64, seen: MapObservations, options: WindowOptions, *, frame: int | None = None
) -> Mask:
    """Tell what `contradicted` does; when most landmarks are, the prediction is wrong and none is.

    Args:
        error_px: Reprojection errors (O,), see `contradicted`.
        seen: The observations.
        options: Uncertainty of a predicted place.
        frame: The only frame whose observations count; None = all count.
    """
    counts: Mask = np.ones(len(seen), dtype=np.bool_) if frame is None else seen.frame == frame
    result = contradicted(np.where(counts, error_px, 0.0), seen, options)
    if 2 * np.count_nonzero(result) < len(np.unique(seen.landmark[counts])):
        return result
    return np.zeros_like(result)
