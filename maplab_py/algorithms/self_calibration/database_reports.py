"""What the commands on segment databases tell their user."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.algorithms.self_calibration.reports import KeptSegment
from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class DatabaseTable:
    """One table of a segment database."""

    table: str
    segments: int
    best_score: float
    worst_score: float


@dataclasses.dataclass(frozen=True)
class DatabaseParameter:
    """How certain segments make one parameter."""

    parameter: str
    reference_sigma: float  # usual deviation after one segment
    best_sigma: float  # after the best segment


@dataclasses.dataclass(frozen=True)
class DatabaseReport(Report):
    """What a segment database holds."""

    file: Path
    metric: str
    selection: str
    capacity: int  # segments per table
    sessions: int
    keyframes: int
    landmarks: int
    imu_samples: int
    tables: tuple[DatabaseTable, ...]
    parameters: tuple[DatabaseParameter, ...]
    segments: tuple[KeptSegment, ...]


@dataclasses.dataclass(frozen=True)
class PrunedSegment:
    """A segment that was tested."""

    mission: str
    first_vertex: str
    distance: float
    limit: float
    chi_square_per_freedom: float
    outdated: bool


@dataclasses.dataclass(frozen=True)
class PruneReport(Report):
    """What was removed from a database."""

    segments_before: int
    segments_after: int
    tested: tuple[PrunedSegment, ...]
