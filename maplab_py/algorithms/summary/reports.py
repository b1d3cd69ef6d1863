"""Reports of summary maps and of the localisation-map workflow."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class SummaryMapReport(Report):
    """Content of a written summary map."""

    landmarks: int
    observations: int
    observers: int
    descriptor_dimensions: int
    megabytes: float  # of the file
    file: Path


@dataclasses.dataclass(frozen=True)
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


@dataclasses.dataclass(frozen=True)
class WorkflowReport(Report):
    """All steps of the workflow that makes a localisation map."""

    steps: tuple[WorkflowStep, ...]
    missions: int
    vertices: int
    good_landmarks: int
    summary_map: str = ""  # file, if one was written
