"""Signals along a mission: states and errors, one value or vector per vertex."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.sightings import residuals
from maplab_py.array_types import F64
from maplab_py.distinct import distinct
from maplab_py.errors import MapError
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.layers.references import errors_against
from maplab_py.vimap import LandmarkQuality, VIMap


@dataclasses.dataclass(frozen=True, eq=False)
class Signal:
    """One plot."""

    title: str
    unit: str
    values: F64  # (V, K), one row per vertex; NaN = not known there
    decimals: int


def vertex_signals(drawing: Drawing, truth: Trajectory | None = None) -> tuple[Signal, ...]:
    """Return what is known of all vertices of a map; what no vertex has is left out.

    Args:
        drawing: The map as it is drawn.
        truth: True trajectory to compare the positions with.
    """
    vi_map = drawing.vi_map
    vertices = vi_map.vertices
    error_px, landmarks = observation_signals(vi_map)
    signals = [
        Signal("velocity", "m/s", vertices.v_M, 2),
        Signal("accelerometer bias", "m/s²", vertices.accel_bias, 3),
        Signal("gyroscope bias", "rad/s", vertices.gyro_bias, 4),
        Signal("reprojection error", "px", error_px[:, None], 2),
        Signal("landmarks", "", landmarks[:, None], 0),
    ]
    if truth is not None:
        error_m = errors_against(drawing, truth)
        signals.append(Signal("position error", "m", error_m[:, None], 3))
    return tuple(signal for signal in signals if _is_known(signal.values))


def observation_signals(vi_map: VIMap) -> tuple[F64, F64]:
    """Return the mean reprojection error (V,) [px] and the number of observed landmarks (V,).

    Landmarks of bad quality, and those behind the camera, do not count in the error; it is NaN for
    vertices without observations and in maps without calibrated cameras.
    """
    count = len(vi_map.vertices)
    keypoints = vi_map.observations
    vertex = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    pairs = distinct(vertex * max(len(vi_map.landmarks), 1) + landmark)
    observed = np.bincount(pairs // max(len(vi_map.landmarks), 1), minlength=count)
    usable = vi_map.landmarks.quality[landmark] != LandmarkQuality.BAD
    keypoints, vertex, landmark = keypoints[usable], vertex[usable], landmark[usable]
    mean_px = np.full(count, np.nan)
    try:
        error_px = residuals(vi_map, keypoints, vi_map.p_G[landmark]).error_px
    except MapError:
        return mean_px, observed.astype(np.float64)
    seen = np.isfinite(error_px)
    number = np.bincount(vertex[seen], minlength=count)
    total = np.bincount(vertex[seen], error_px[seen], minlength=count)
    np.divide(total, number, out=mean_px, where=number > 0)
    return mean_px, observed.astype(np.float64)


def _is_known(values: F64) -> bool:
    """Tell whether some value is finite and not zero."""
    return bool(np.any(np.isfinite(values) & (values != 0.0)))
