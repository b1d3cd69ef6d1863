"""How well two landmarks of a closure agree: how far apart they are, and how far they may be."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closures import Closures
from maplab_py.algorithms.loop_closure.features import keypoint_rays, points_in_mission
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows
from maplab_py.vision.point_covariance import covariance_by_rays, squared_sigmas

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_POSE_DRIFT = 0.01
"""Error of a landmark by those of the poses that saw it, as part of its distance."""


@dataclasses.dataclass(frozen=True, eq=False)
class Agreement:
    """Landmarks of the query and of the place, once the query is where verification put it."""

    gap_m: F64  # (N,) between them
    depth_m: F64  # (N,) of the place's landmark from the query
    squared_sigmas: F64  # (N,) squared Mahalanobis distance, three degrees of freedom


def compare_landmarks(
    vi_map: VIMap, closures: Closures, closure: I64, source: I64, target: I64, sigma_px: float
) -> Agreement:
    """Compare landmarks of queries with those of places.

    Args:
        vi_map: The map.
        closures: The closures.
        closure: Row of the closure (N,) that matched them; its covariance is known.
        source: Landmark (N,) that the query sees.
        target: Landmark (N,) of the place.
        sigma_px: Standard deviation of keypoints.
    """
    query = closures.query_vertex
    mission = vi_map.vertices.mission[closures.place_vertex].astype(np.int64)
    T_M_I = closures.T_M_I
    T_I_G = se3.inverse(vi_map.T_G_I[query])
    p_I = se3.transform(T_I_G[closure], vi_map.p_G[source])
    p_M = points_in_mission(vi_map, target, mission[closure])
    gap_M = se3.transform(T_M_I[closure], p_I) - p_M
    depth_m = np.linalg.norm(p_M - T_M_I[closure, 4:], axis=1)
    landmarks, row = np.unique(np.concatenate([source, target]), return_inverse=True)
    squared = squared_sigmas(
        gap_M,
        p_I,
        _POSE_DRIFT * depth_m,
        closure,
        row[: len(source)],
        row[len(source) :],
        landmark_covariance(vi_map, landmarks, sigma_px),
        so3.to_matrix(se3.compose(T_M_I, T_I_G)[:, :4]),
        so3.to_matrix(se3.inverse(vi_map.T_G_M)[mission, :4]),
        so3.to_matrix(T_M_I[:, :4]),
        closures.covariance,
    )
    return Agreement(np.asarray(np.linalg.norm(gap_M, axis=1)), depth_m, squared)


def landmark_covariance(vi_map: VIMap, landmarks: I64, sigma_px: float) -> F64:
    """Return the covariances (N, 3, 3) of landmarks in G, as their keypoints determine them.

    Landmarks without rays (those of a lidar) are taken as unknown.
    """
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    owner = np.repeat(np.arange(len(landmarks)), np.diff(vi_map.observation_start)[landmarks])
    origin_I, _, rad_per_px, seen = keypoint_rays(vi_map, keypoints)
    centre_G = se3.transform(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints]], origin_I)
    to_point_G = vi_map.p_G[landmarks][owner] - centre_G
    return covariance_by_rays(to_point_G, sigma_px * rad_per_px, seen, owner, len(landmarks))
