"""Report of landmark sparsification."""

from __future__ import annotations

import dataclasses

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class CoverageOfMission:
    """Good landmarks per keyframe of one mission."""

    mission: str  # beginning of its id
    keyframes: int
    min_before: int
    median_before: float
    min_after: int
    median_after: float
    below_wanted: int  # keyframes that could have had the wanted number and see fewer


@dataclasses.dataclass(frozen=True)
class KeyframeCoverage:
    """Good landmarks that one keyframe sees."""

    vertex: str
    before: int
    after: int


@dataclasses.dataclass(frozen=True)
class SparsificationReport(Report):
    """Remaining landmarks and coverage of the keyframes."""

    landmarks_before: int
    good_landmarks: int
    landmarks_after: int
    observations_before: int
    observations_after: int
    keyframes: int
    wanted_per_keyframe: int
    below_wanted: int  # keyframes that could have had the wanted number and see fewer
    method: str
    parts: int
    objective: float  # score and coverage value of the selection
    bound: float  # upper bound on the objective; NaN if unknown
    missions: tuple[CoverageOfMission, ...]
    worst_keyframes: tuple[KeyframeCoverage, ...]
    note: str = ""
