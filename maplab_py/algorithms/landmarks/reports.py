"""Reports of the landmark algorithms."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report

_MANY_BAD = 0.8
"""Share of bad landmarks from which on the criteria are doubtful rather than the landmarks."""
_FLAGS = {
    "too_few_observers": "--elq_min_observers (keyframes have fewer observers)",
    "too_small_angle": "--elq_min_observation_angle_deg",
    "too_near_or_behind": "--elq_min_distance_from_closest_observer",
    "too_far": "--elq_max_distance_from_closest_observer",
    "too_large_error": "--elq_max_reprojection_error_px",
}


@dataclasses.dataclass(frozen=True)
class LandmarkQualityReport(Report):
    """Verdicts on the landmarks of the chosen missions."""

    landmarks: int
    good: int
    bad: int
    unknown: int
    good_before: int
    bad_before: int
    unknown_before: int
    # why landmarks are bad; one may count several times
    too_few_observers: int = 0
    too_small_angle: int = 0
    too_uncertain: int = 0  # predicted covariance
    too_near_or_behind: int = 0
    too_far: int = 0
    too_large_error: int = 0
    note: str = ""

    @property
    def advice(self) -> str:
        """Name the criterion that most landmarks fail if most of them are bad."""
        if self.bad <= _MANY_BAD * max(self.landmarks, 1):
            return ""
        criterion = max(_FLAGS, key=lambda name: getattr(self, name))
        return (
            f"{100.0 * self.bad / self.landmarks:.0f} % of the landmarks are bad, "
            f"{getattr(self, criterion)} of them for {criterion.replace('_', ' ')}: "
            f"change {_FLAGS[criterion]}, or see `why <landmark>`"
        )


@dataclasses.dataclass(frozen=True)
class RetriangulationReport(Report):
    """Number of landmarks with a new position."""

    landmarks: int
    triangulated: int
    too_few_observations: int  # fewer than two observations: position unchanged
    undetermined: int  # parallel rays: position unchanged
    behind_camera: int  # behind an observer: position unchanged
    median_shift_m: float
    quality: LandmarkQualityReport


@dataclasses.dataclass(frozen=True)
class TrackReport(Report):
    """New landmarks from feature tracks."""

    tracks: int  # unused tracks of two or more keypoints
    landmarks_added: int
    observations_added: int
    undetermined: int  # parallel rays or behind a camera: no landmark made
    retriangulation: RetriangulationReport | None


@dataclasses.dataclass(frozen=True)
class LandmarkRemovalReport(Report):
    """Removed landmarks."""

    landmarks_removed: int
    observations_removed: int
    landmarks_left: int
    unknown_left: int


@dataclasses.dataclass(frozen=True)
class InvalidObservationReport(Report):
    """Detached observations, by the first reason that applied."""

    observations: int
    twice_in_frame: int
    behind_camera: int
    too_large_error: int
    landmarks_added: int  # from detached observations of one track
    observations_reattached: int
    landmarks_without_observations: int  # landmarks that lost observations
