"""What imports of trajectories and positions report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class TrajectoryImport(Report):
    """Measurements, or a mission, that a trajectory became."""

    file: Path
    kind: str
    mission: str
    poses_in_file: int
    added: int  # absolute poses, edges, or vertices
    without_pose: int = 0  # vertices, or pairs of neighbours, that the file does not cover
    moved_m: float = 0.0  # by the alignment, at the first vertex
    turned_deg: float = 0.0  # about the vertical, by the alignment
    notes: tuple[str, ...] = ()

    @property
    def advice(self) -> str:
        """Name the flag that makes optvi use the measurements."""
        flag = {
            "absolute": "--ba_include_absolute_pose_constraints",
            "odometry": "--ba_include_6dof_odometry",
        }.get(self.kind, "")
        return f"optvi {flag} uses them" if flag and self.added else ""


@dataclasses.dataclass(frozen=True)
class LeftOutFixes:
    """Rows or messages that are no fixes."""

    reason: str
    count: int


@dataclasses.dataclass(frozen=True)
class GpsImport(Report):
    """Positions that became measurements of a mission."""

    file: Path
    mission: str
    fixes_in_file: int
    added: int  # each to another vertex
    left_out: tuple[LeftOutFixes, ...]
    origin_latitude_deg: float
    origin_longitude_deg: float
    origin_altitude_m: float
    moved_m: float  # by the alignment, at the first vertex
    turned_deg: float  # about the vertical, by the alignment
    median_error_m: float  # between fixes and the aligned mission

    @property
    def advice(self) -> str:
        """Name the flag that makes optvi use the positions."""
        return "optvi --ba_include_absolute_pose_constraints uses them and leaves out outliers"


@dataclasses.dataclass(frozen=True)
class WheelImport(Report):
    """Wheel odometry that became edges of a mission."""

    file: Path
    kind: str  # poses, motions or velocities
    mission: str
    sensor_id: str
    rows_in_file: int
    added: int  # edges
    without_edge: int  # pairs of neighbouring vertices that the file does not cover
    distance_ratio: float  # of the wheels, at the scale known before, and the mission

    @property
    def advice(self) -> str:
        """Name the flags that make optvi use the edges."""
        return "optvi --ba_include_wheel_odometry uses them, --ba_fix_wheel_scale=false estimates their scale"
