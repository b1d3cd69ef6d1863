"""Distance between matched landmarks of a closure and its covariance."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.covariance import landmark_covariance
from maplab_py.algorithms.loop_closure.closure_table import Closures
from maplab_py.algorithms.loop_closure.features import points_in_mission
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3
from maplab_py.vimap import VIMap
from maplab_py.vision.point_covariance import (
    ClosurePoses,
    LandmarkPairs,
    squared_sigmas,
)

_POSE_DRIFT = 0.01
"""Standard deviation of a landmark due to errors of observing poses, relative to its distance."""
_APART_RATIO = 0.1
"""Distance of two landmarks, relative to their depth, beyond which a pair is doubtful."""
_DOUBTFUL_SQUARED_SIGMAS = 6.25
"""Exceeded by a tenth of the pairs that are one point: chi square of three degrees of freedom."""


@dataclasses.dataclass(frozen=True, eq=False)
class Agreement:
    """Distances of landmarks of the query and the place after the closure is applied."""

    gap_m: F64  # (N,) between them
    depth_m: F64  # (N,) of the place's landmark from the query
    squared_sigmas: F64  # (N,) squared Mahalanobis distance, three degrees of freedom

    def is_doubtful(self, distance_m: float) -> Mask:
        """Return which pairs (N,) are one point less likely, or because nobody knows their depth.

        These are the tenth of the true pairs that is farthest apart in deviations, and pairs farther
        apart than a distance and a tenth of their depth.
        """
        is_apart = self.gap_m > np.maximum(distance_m, _APART_RATIO * self.depth_m)
        return np.asarray(is_apart | (self.squared_sigmas > _DOUBTFUL_SQUARED_SIGMAS))


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
    pairs = LandmarkPairs(
        gap_M, p_I, _POSE_DRIFT * depth_m, closure, row[: len(source)], row[len(source) :]
    )
    poses = ClosurePoses(
        R_M_Gq=so3.to_matrix(se3.compose(T_M_I, T_I_G)[:, :4]),
        R_M_G=so3.to_matrix(se3.inverse(vi_map.T_G_M)[mission, :4]),
        R_M_I=so3.to_matrix(T_M_I[:, :4]),
        covariance=closures.covariance,
    )
    squared = squared_sigmas(pairs, landmark_covariance(vi_map, landmarks, sigma_px), poses)
    return Agreement(np.asarray(np.linalg.norm(gap_M, axis=1)), depth_m, squared)
