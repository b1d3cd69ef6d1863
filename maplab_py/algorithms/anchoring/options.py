"""Options and reports of anchoring."""

import dataclasses

from maplab_py.options import Options, option
from maplab_py.report import Report


class AnchoringOptions(Options, prefix="anchor_transform_"):
    """Criteria for the alignment of two missions, with maplab's names."""

    min_inlier_count: int = 4
    """Verified closures between two missions that must agree on one alignment"""
    min_inlier_ratio: float = 0.4
    """Ratio of the closures between two missions that must agree"""
    ransac_max_orientation_error_rad: float = 0.1
    """Largest difference in yaw of closures that agree"""
    ransac_max_position_error_m: float = 1.0
    """Largest difference in position of closures that agree"""
    add_to_database: bool = option(True, flag="add_anchored_missions_to_database")
    """Anchor missions through missions that are anchored by the same command as well"""
    hypothesis: int = option(0, flag="anchor_hypothesis")
    """Number of an alignment in the report of anchor_all_missions that is to be used, whatever its evidence;
    0 = none"""


@dataclasses.dataclass(frozen=True)
class MissionAlignment:
    """Result of the alignment of two missions."""

    missions: str  # "short id - short id"
    closures: int  # verified closures between the two missions
    agreeing: int
    rms_m: float  # of the agreeing closures' positions
    verdict: str  # "used" or the reason why not


@dataclasses.dataclass(frozen=True)
class AlignmentHypothesis:
    """One of several alignments of two missions that closures support."""

    number: int  # for --anchor_hypothesis
    missions: str  # "short id - short id"
    closures: int
    stretches: tuple[int, int]  # of the two trajectories, about a metre each, that it explains
    only_this: tuple[int, int]  # of these, not explained by the best of the others
    position_m: tuple[float, float, float]  # of the first mission's frame in the second's
    yaw_deg: float
    outcome: str  # wins, runner-up, loses, undecided


class AnchoringReport(Report):
    """Anchored missions."""

    already_known: tuple[str, ...]
    anchored: tuple[str, ...]
    not_anchored: dict[str, str]  # mission: reason
    alignments: tuple[MissionAlignment, ...]
    by_absolute_poses: tuple[str, ...] = ()  # of the anchored ones
    hypotheses: tuple[AlignmentHypothesis, ...] = ()  # where there are several, or doubts
    notes: tuple[str, ...] = ()
    reason: str = ""  # why no mission could be anchored

    @property
    def advice(self) -> str:
        """Name the command that explains a mission that was not anchored."""
        return f"see `why {next(iter(self.not_anchored))}`" if self.not_anchored else ""

    @property
    def failure(self) -> str:
        """Return a line on missions whose base frames remain unknown."""
        if self.reason:
            return self.reason
        if not self.not_anchored:
            return ""
        return "not anchored: " + "; ".join(
            f"{mission} ({why})" for mission, why in self.not_anchored.items()
        )
