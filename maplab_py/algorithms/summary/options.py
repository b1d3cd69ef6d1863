"""Options of summary maps."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option


@dataclasses.dataclass(frozen=True)
class SummaryMapOptions:
    """Content of a summary map."""

    flag_prefix: ClassVar[str] = "summary_map_"

    descriptor_step: float = option(
        1.0 / 32.0,
        help="Projected descriptors are rounded to multiples of this, which makes the file half as "
        "large; noise within a track is about 1; 0 = not rounded.",
    )
    max_observations_per_landmark: int = option(
        0, help="Observations that are kept of a landmark, spread over all of them; 0 = all."
    )
    position_step_m: float = option(
        1.0 / 1024.0,
        help="Positions are rounded to multiples of this; 0 = not rounded.",
        unit="m",
    )
    covariances: bool = option(
        False, help="Write a covariance for every landmark, 24 bytes that hardly compress."
    )
    landmark_ids: bool = option(
        False,
        help="Write the ids of the landmarks, 16 bytes that do not compress; those of the observing "
        "vertices are written in any case.",
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("descriptor_step", "position_step_m"):
            if getattr(self, name) < 0.0:
                raise FlagError(f"--summary_map_{name} must not be negative")
        if self.max_observations_per_landmark < 0:
            raise FlagError("--summary_map_max_observations_per_landmark must not be negative")
