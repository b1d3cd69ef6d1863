"""Reports of localisation."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class Distribution:
    """Order statistics of a quantity."""

    median: float
    mean: float
    percentile_95: float
    largest: float


@dataclasses.dataclass(frozen=True)
class LocalizationReport(Report):
    """Number, accuracy and run time of localised queries."""

    map_kind: str  # full or summary
    map_landmarks: int
    map_observations: int
    queries: int
    localized: int
    localized_share: float
    refused: dict[str, int]  # by reason
    reference: str  # reference of the errors; empty without a reference
    queries_with_reference: int
    success: int  # localised within the wanted position error
    success_share: float  # of queries with reference
    wrong: int  # localised with more
    success_error_m: float  # the wanted position error
    position_error_m: Distribution | None  # of localised queries
    orientation_error_deg: Distribution | None
    inliers: Distribution | None
    matching_ms: Distribution | None  # per query
    ransac_ms: Distribution | None
    seconds: float

    @property
    def failure(self) -> str:
        """Say that nothing was localised."""
        if self.localized:
            return ""
        reasons = ", ".join(f"{why}: {count}" for why, count in self.refused.items())
        return f"none of {self.queries} queries was localised ({reasons})"
