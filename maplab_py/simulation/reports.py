"""Reports of simulated data and of the demonstration on them."""

import dataclasses
from pathlib import Path

from maplab_py.report import Report

_MAX_ATE_RATIO = 0.25
_MAX_OFFSET_M = 0.05
_MAX_YAW_DEG = 0.3


@dataclasses.dataclass(frozen=True)
class ScenarioLine:
    """One scenario."""

    scenario: str
    sessions: int
    seconds: float
    description: str


class ScenarioList(Report):
    """The scenarios that come with the program."""

    scenarios: tuple[ScenarioLine, ...]


@dataclasses.dataclass(frozen=True)
class SimulatedMap:
    """One session that was written."""

    folder: Path
    vertices: int
    keypoints: int
    landmarks: int


class SimulatedMaps(Report):
    """All sessions of a scenario, and where the truth is."""

    maps: tuple[SimulatedMap, ...]
    truth: Path
    raw_data: tuple[Path, ...]  # EuRoC folders


@dataclasses.dataclass(frozen=True)
class DemoStep:
    """One command of the workflow."""

    command: str
    seconds: float


@dataclasses.dataclass(frozen=True)
class DemoMission:
    """Errors of one session before and after."""

    mission: str
    vertices: int
    ate_before_m: float
    ate_after_m: float
    anchoring_offset_m: float
    anchoring_yaw_deg: float


class DemoReport(Report):
    """Errors of three drifting sessions before and after the workflow."""

    steps: tuple[DemoStep, ...]
    missions: tuple[DemoMission, ...]
    ate_before_m: float  # every session aligned by itself: they have no common frame yet
    ate_after_m: float  # all sessions aligned together
    scale_after: float
    map_folder: Path

    @property
    def failure(self) -> str:
        """Return which accuracy goal was missed."""
        misplaced = [
            line.mission
            for line in self.missions
            if not (
                line.anchoring_offset_m <= _MAX_OFFSET_M and line.anchoring_yaw_deg <= _MAX_YAW_DEG
            )
        ]
        if misplaced:
            return f"wrongly anchored: {', '.join(misplaced)}"
        if not self.ate_after_m <= _MAX_ATE_RATIO * self.ate_before_m:
            return f"the error is more than {_MAX_ATE_RATIO:g} of the initial error"
        return ""
