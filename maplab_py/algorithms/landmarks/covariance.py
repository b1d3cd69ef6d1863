"""Predicted covariance of landmarks from the rays of their keypoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.algorithms.landmarks.keypoint_rays import keypoint_rays
from maplab_py.array_types import F64, I64
from maplab_py.geometry import se3, symmetric
from maplab_py.vimap import VIMap
from maplab_py.vimap.table import ragged_rows
from maplab_py.vision.point_covariance import covariance_by_rays


def landmark_covariance(vi_map: VIMap, landmarks: I64, sigma_px: ArrayLike) -> F64:
    """Return the covariances (N, 3, 3) of landmarks in G from their keypoints; poses are exact.

    Landmarks without rays (lidar) have unknown position.

    Args:
        vi_map: The map.
        landmarks: Landmark rows (N,).
        sigma_px: Standard deviation of keypoints: of all, or (K,) of each keypoint of the map.
    """
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    owner = np.repeat(np.arange(len(landmarks)), np.diff(vi_map.observation_start)[landmarks])
    origin_I, _, rad_per_px, seen = keypoint_rays(vi_map, keypoints)
    centre_G = se3.transform(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints]], origin_I)
    to_point_G = vi_map.p_G[landmarks][owner] - centre_G
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(vi_map.keypoints))
    sigma_rad = sigma[keypoints] * rad_per_px
    return covariance_by_rays(to_point_G, sigma_rad, seen, owner, len(landmarks))


def largest_sigma(covariance: F64) -> F64:
    """Return the standard deviation (N,) along the worst axis of covariances (N, 3, 3)."""
    if not len(covariance):
        return np.zeros(0)
    return np.asarray(np.sqrt(np.maximum(symmetric.eigen(covariance)[0][:, -1], 0.0)))
