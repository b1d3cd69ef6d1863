"""Weights of a window's observations of a map."""

from __future__ import annotations

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class MapRule:
    """Weights of observations of the map."""

    sigma_px: float = 1.0  # of a keypoint (Paper I)
    tilt_sigma_rad: float = float(np.radians(0.5))
    base_sigma_m: float = float(np.sqrt(20.0))  # of T_G_M before anything is observed
    base_sigma_rad: float = float(np.sqrt(np.radians(90.0)))
    estimates_landmarks: bool = False  # with the map's covariances; else they are exact
