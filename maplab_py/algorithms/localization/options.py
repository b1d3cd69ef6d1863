"""Options of localisation. Names and defaults are maplab's where it has the option."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class LocalizationOptions:
    """How images are matched with a map and when a pose is believed."""

    flag_prefix: ClassVar[str] = "localization_"

    num_neighbors: int = option(3, help="Landmarks to retrieve per keypoint.")
    num_words_for_nn_search: int = option(
        24, help="Cells of the multi-index that are searched per keypoint."
    )
    max_bit_fraction: float = option(
        0.26,
        help="Largest part of a descriptor's bits in which a match may differ; full maps only.",
    )
    max_projected_distance: float = option(
        40.0, help="Largest squared distance of projected descriptors of a match; summary maps."
    )
    places: int = option(6, help="Places of the map that are tried for each query.")
    min_shared_landmarks: int = option(
        5, help="Observers of the map that share so many landmarks belong to one place."
    )
    min_matches: int = option(5, help="Matches with one place that are worth verifying.")
    ransac_pixel_sigma: float = option(
        2.0, help="Largest reprojection error of an inlier.", unit="px"
    )
    num_ransac_iters: int = option(500, help="Most samples of two matches per place.")
    min_inlier_count: int = option(8, help="Landmarks that must agree with the pose.")
    min_inlier_ratio: float = option(
        0.03, help="Part of the keypoints matched in the place that must agree."
    )
    max_gravity_misalignment_deg: float = option(
        5.0, help="Largest angle between gravity as the query has it and as found.", unit="deg"
    )
    max_position_sigma_m: float = option(
        0.5, help="Poses whose position is less certain are not believed.", unit="m"
    )
    seed: int = option(0, help="Seed of all random choices.")

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("num_neighbors", "num_words_for_nn_search", "places", "num_ransac_iters"):
            if getattr(self, name) < 1:
                raise FlagError(f"--localization_{name} must be at least 1")
        if self.min_inlier_count < 3:
            raise FlagError("--localization_min_inlier_count must be at least 3")
        for name in ("ransac_pixel_sigma", "max_position_sigma_m", "max_projected_distance"):
            if getattr(self, name) <= 0.0:
                raise FlagError(f"--localization_{name} must be positive")
