"""Options of localisation. Names and defaults are maplab's where it has the option."""

from __future__ import annotations

import dataclasses

from maplab_py.options import Options, option
from maplab_py.report import Report


class LocalizationOptions(Options, prefix="localization_"):
    """Matching of images with a map and acceptance of poses."""

    num_neighbors: int = option(3, ge=1)
    """Landmarks to retrieve per keypoint."""
    num_words_for_nn_search: int = option(24, ge=1)
    """Cells of the multi-index that are searched per keypoint."""
    max_bit_fraction: float = 0.26
    """Largest fraction of descriptor bits in which a match may differ; full maps only."""
    max_descriptor_distance: float = option(0.45, gt=0)
    """Largest Euclidean distance of a match whose descriptors are not binary, scaled to unit length, a
    third more for XFeat; full maps only."""
    max_projected_distance: float = option(40.0, gt=0)
    """Largest squared distance of projected descriptors of a match in 10 dimensions, a quarter more for
    XFeat; in proportion with more dimensions; summary maps."""
    places: int = option(6, ge=1)
    """Places of the map that are tried for each query."""
    min_shared_landmarks: int = 5
    """Number of shared landmarks above which observers of the map belong to one place."""
    min_matches: int = 5
    """Smallest number of matches with a place for verification."""
    ransac_pixel_sigma: float = option(2.0, gt=0, unit="px")
    """Largest reprojection error of an inlier."""
    num_ransac_iters: int = option(500, ge=1)
    """Largest number of samples of two matches per place."""
    min_inlier_count: int = option(8, ge=3)
    """Landmarks that must agree with the pose."""
    min_inlier_ratio: float = 0.03
    """Fraction of the keypoints matched in the place that must agree."""
    max_gravity_misalignment_deg: float = 5.0
    """Largest angle between gravity in the query's frame and in the estimated pose."""
    max_position_sigma_m: float = option(0.5, gt=0)
    """Largest standard deviation of the position of an accepted pose."""
    seed: int = 0
    """Seed of all random choices."""


@dataclasses.dataclass(frozen=True)
class Distribution:
    """Order statistics of a quantity."""

    median: float
    mean: float
    percentile_95: float
    largest: float


class LocalizationReport(Report):
    """Number, accuracy and run time of localised queries."""

    map_kind: str  # full or summary, and the type of its descriptors unless they are binary
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
        """Return the failure if nothing was localised."""
        if self.localized:
            return ""
        reasons = ", ".join(f"{why}: {count}" for why, count in self.refused.items())
        return f"none of {self.queries} queries was localised ({reasons})"

    def display(self) -> LocalizationReport:
        """Return the report with figures that are called differences where there is no truth."""
        if not self.reference.startswith(QUERY_PATH):
            return self
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return _DifferenceReport(**values)


QUERY_PATH = "the query's own path"


class _DifferenceReport(LocalizationReport):
    """Result compared with the query's own path, which has errors too."""

    success: int = dataclasses.field(metadata={"title": "near the path"})
    success_share: float = dataclasses.field(metadata={"title": "share near the path"})
    wrong: int = dataclasses.field(metadata={"title": "away from the path"})
    success_error_m: float = dataclasses.field(metadata={"title": "near means below", "unit": "m"})
    position_error_m: Distribution | None = dataclasses.field(
        metadata={"title": "difference", "unit": "m"}
    )
    orientation_error_deg: Distribution | None = dataclasses.field(
        metadata={"title": "difference", "unit": "deg"}
    )
