"""Options of summary maps."""

import dataclasses
from pathlib import Path

from maplab_py.options import Options, option
from maplab_py.report import Report


class SummaryMapOptions(Options, prefix="summary_map_"):
    """Content of a summary map."""

    descriptor_step: float = option(1.0 / 32.0, ge=0)
    """Projected descriptors are rounded to multiples of this, XFeat's of 8 times as much (to bytes), which
    makes the file half as large; noise within a track is about 1; 0 = not rounded."""
    max_observations_per_landmark: int = option(0, ge=0)
    """Observations that are kept of a landmark, spread over all of them; 0 = all."""
    position_step_m: float = option(1.0 / 1024.0, ge=0)
    """Positions are rounded to multiples of this; 0 = not rounded."""
    covariances: bool = False
    """Write a covariance for every landmark, 24 bytes that hardly compress."""
    landmark_ids: bool = False
    """Write the ids of the landmarks, 16 bytes that do not compress; those of the observing vertices are
    written in any case."""


class SummaryMapReport(Report):
    """Content of a written summary map."""

    landmarks: int
    observations: int
    observers: int
    descriptor_dimensions: int
    megabytes: float  # of the file
    file: Path


class SummaryMapContent(Report):
    """Content of a loaded summary map."""

    landmarks: int
    observations: int
    observers: int
    descriptor_dimensions: int
    has_ids: bool
    has_projection: bool
    cameras: int
    median_position_sigma_m: float | None  # of landmarks, where the file has covariances
    mean_existence: float | None  # probability that a landmark exists, where the map had evidence
    extent_m: tuple[float, float, float]  # of the observers
    megabytes: float


@dataclasses.dataclass(frozen=True)
class WorkflowStep:
    """Result and run time of a step."""

    step: str
    vertices: int
    landmarks: int
    seconds: float
    note: str


class WorkflowReport(Report):
    """All steps of the workflow that makes a localisation map."""

    steps: tuple[WorkflowStep, ...]
    missions: int
    vertices: int
    good_landmarks: int
    summary_map: str = ""  # file, if one was written
