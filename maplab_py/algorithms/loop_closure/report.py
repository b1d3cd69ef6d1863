"""What loop closure found, and why it refused what it refused."""

from __future__ import annotations

import dataclasses
from enum import Enum

from maplab_py.report import Report


class Verdict(Enum):
    """What became of one candidate."""

    ACCEPTED = "accepted"
    FEW_INLIERS = "too few inliers"
    LOW_RATIO = "too low a part of inliers"
    TILTED = "gravity deviates"
    IMPLAUSIBLE = "corrects more than the mission can have drifted"
    AMBIGUOUS = "looks the same as another place"
    NO_SUPPORT = "no closures nearby agree"
    CONTRADICTED = "closures nearby disagree"
    REMOVED = "removed by hand"
    UNCERTAIN = "too uncertain rotation"


@dataclasses.dataclass(frozen=True)
class LoopClosureReport(Report):
    """Counts of one search, and what was done with the result."""

    query_vertices: int = 0
    database_landmarks: int = 0
    descriptor_matches: int = 0
    candidates: int = 0  # pairs of a query vertex and a place that were verified
    accepted: int = 0
    accepted_vertices: int = 0
    refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    missions_joined: tuple[str, ...] = ()  # "short id - short id: closures"
    largest_correction_m: float = 0.0
    median_correction_m: float = 0.0
    edges_added: int = 0
    landmarks_merged: int = 0
    observations_moved: int = 0
    merges_refused: dict[str, int] = dataclasses.field(default_factory=dict)  # by reason
    notes: tuple[str, ...] = ()
    reason: str = ""  # why there is no result, empty when there is one

    @property
    def failure(self) -> str:
        """Say why nothing came of it."""
        return self.reason
