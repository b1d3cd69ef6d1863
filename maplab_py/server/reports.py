"""Reports of the server and of its commands."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class RobotLine:
    """One robot."""

    robot: str
    missions: int
    missions_anchored: int
    submaps_merged: int
    submaps_waiting: int


@dataclasses.dataclass(frozen=True)
class EventLine:
    """One line of the log."""

    time: str
    event: str


@dataclasses.dataclass(frozen=True)
class ServerStatus(Report):
    """State of a map server and its map."""

    is_running: bool
    spool: Path
    merged_map_folder: str
    url: str
    missions: int
    vertices: int
    landmarks: int
    incoming: int  # not taken yet
    preparing: int
    waiting: int  # for a worker, or for the submap that they adjoin
    merged: int
    rejected: int
    since_joint_optimization: int  # submaps
    published_s_ago: float | None
    robots: tuple[RobotLine, ...]
    last_events: tuple[EventLine, ...]
    problem: str = ""


@dataclasses.dataclass(frozen=True)
class ServeReport(Report):
    """Work of a server until it stopped."""

    merged_map_folder: str
    submaps_merged: int  # by this run
    submaps_rejected: int
    submaps_waiting: int  # left for the next run
    missions: int
    vertices: int
    landmarks: int
    joint_optimizations: int
    seconds: float
    problem: str = ""

    @property
    def failure(self) -> str:
        """Error that kept the server from publishing its last state."""
        return self.problem


@dataclasses.dataclass(frozen=True)
class DeletedMissions(Report):
    """Missions that the server has removed from its map."""

    missions: tuple[str, ...]
    vertices: int


@dataclasses.dataclass(frozen=True)
class LookupReport(Report):
    """Position of a point of a robot's sensor in the global frame."""

    robot: str
    mission: str
    is_anchored: bool
    timestamp_ns: int
    p_G: tuple[float, float, float]
    p_G_sensor: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class DenseMapReport(Report):
    """Points of a dense map in a sphere."""

    points: int
    resources: int  # clouds with a point in the sphere
    output_file: Path | None = None


@dataclasses.dataclass(frozen=True)
class PushReport(Report):
    """A submap that was put into a spool."""

    folder: Path


@dataclasses.dataclass(frozen=True)
class PlayedRobots(Report):
    """Simulated submaps that were put into a spool."""

    robots: int
    submaps: int
    truth: Path | None  # of simulated sessions
    seconds: float
