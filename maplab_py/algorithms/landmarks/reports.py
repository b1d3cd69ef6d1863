"""What the landmark algorithms found."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


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
    too_near_or_behind: int = 0
    too_far: int = 0
    too_large_error: int = 0


@dataclasses.dataclass(frozen=True)
class RetriangulationReport(Report):
    """How many landmarks have a new place."""

    landmarks: int
    triangulated: int
    too_few_observations: int  # fewer than two: left in place
    undetermined: int  # parallel rays: left in place
    behind_camera: int  # would lie behind an observer: left in place
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
class RemovalReport(Report):
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
    landmarks_without_observations: int  # now, of those that had some
