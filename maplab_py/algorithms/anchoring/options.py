"""Options and report of anchoring."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.options import option
from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class AnchoringOptions:
    """When two missions count as aligned. Names are maplab's."""

    flag_prefix: ClassVar[str] = "anchor_transform_"

    min_inlier_count: int = option(
        4, help="Verified closures between two missions that must agree on one alignment"
    )
    min_inlier_ratio: float = option(
        0.4, help="Part of the closures between two missions that must agree"
    )
    ransac_max_orientation_error_rad: float = option(
        0.1, help="Largest difference in yaw of closures that agree", unit="rad"
    )
    ransac_max_position_error_m: float = option(
        1.0, help="Largest difference in position of closures that agree", unit="m"
    )


@dataclasses.dataclass(frozen=True)
class MissionAlignment:
    """How two missions were aligned, or why not."""

    missions: str  # "short id - short id"
    closures: int  # verified ones between the two
    agreeing: int
    rms_m: float  # of the agreeing closures' positions
    verdict: str  # "used" or the reason why not


@dataclasses.dataclass(frozen=True)
class AnchoringReport(Report):
    """Which missions were anchored."""

    already_known: tuple[str, ...]
    anchored: tuple[str, ...]
    not_anchored: dict[str, str]  # mission: reason
    alignments: tuple[MissionAlignment, ...]
    notes: tuple[str, ...] = ()
    reason: str = ""  # why nothing could be done at all

    @property
    def failure(self) -> str:
        """Say which missions stay unknown."""
        if self.reason:
            return self.reason
        if not self.not_anchored:
            return ""
        return "not anchored: " + "; ".join(
            f"{mission} ({why})" for mission, why in self.not_anchored.items()
        )
