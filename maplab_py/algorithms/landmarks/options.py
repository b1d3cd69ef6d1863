"""Options of the landmark algorithms; maplab's names and defaults."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class LandmarkQualityOptions:
    """Criteria for well-constrained landmarks."""

    flag_prefix: ClassVar[str] = "elq_"

    min_observers: int = option(2, help="Smallest number of vertices that observe a landmark.")
    min_observation_angle_deg: float = option(
        2.0, help="Smallest angle between the two most different rays.", unit="deg"
    )
    max_relative_sigma: float = option(
        0.05,
        help="Largest standard deviation of a landmark along its worst axis, relative to its distance from "
        "the closest observer; predicted from its rays and reprojection errors; negative = not checked.",
    )
    min_distance_from_closest_observer: float = option(
        0.05, help="Smallest distance of a landmark from its closest observer.", unit="m"
    )
    max_distance_from_closest_observer: float = option(
        40.0, help="Largest distance of a landmark from its closest observer.", unit="m"
    )
    max_reprojection_error_px: float = option(
        -1.0,
        help="Largest reprojection error of any observation; negative = not checked.",
        unit="px",
    )
    lidar_min_observers: int = option(
        1, help="Smallest number of vertices that observe a lidar landmark."
    )
    lidar_min_distance_from_closest_observer: float = option(
        1.0, help="Smallest distance of a lidar landmark from its closest observer.", unit="m"
    )
    lidar_max_distance_from_closest_observer: float = option(
        60.0, help="Largest distance of a lidar landmark from its closest observer.", unit="m"
    )
    lidar_max_observation_error_m: float = option(
        -1.0,
        help="Largest distance of any lidar observation from its landmark; negative = not checked.",
        unit="m",
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.min_observers < 0 or self.lidar_min_observers < 0:
            raise FlagError("--elq_min_observers must not be negative")
        if not 0.0 <= self.min_observation_angle_deg <= 180.0:
            raise FlagError("--elq_min_observation_angle_deg must be in [0, 180]")
        for prefix in ("", "lidar_"):
            low = getattr(self, f"{prefix}min_distance_from_closest_observer")
            high = getattr(self, f"{prefix}max_distance_from_closest_observer")
            if low > high:
                raise FlagError(
                    f"--elq_{prefix}min_distance_from_closest_observer is larger than the maximum"
                )


@dataclasses.dataclass(frozen=True)
class InvalidObservationOptions:
    """Criteria for invalid observations."""

    flag_prefix: ClassVar[str] = "rio_"

    max_reprojection_error_px: float = option(
        50.0, help="Largest reprojection error of a valid observation.", unit="px"
    )
    make_new_landmarks: bool = option(
        True, help="Make new landmarks from detached observations of one feature track."
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.max_reprojection_error_px <= 0.0:
            raise FlagError("--rio_max_reprojection_error_px must be positive")
