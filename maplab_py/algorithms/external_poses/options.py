"""Options and reports of poses from other sources."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import FlagError
from maplab_py.geometry import se3
from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import Options, option
from maplab_py.report import Report

_UNIT_TOLERANCE = 1e-2
"""By which the length of a quaternion in a flag may differ from one."""


class TrajectoryOptions(Options):
    """Use of a trajectory, and its uncertainty."""

    kind: str = option("absolute", choices=("absolute", "odometry", "mission"), flag="as")
    """Absolute pose measurements or odometry edges of a mission of the map, or a mission of its own"""
    position_sigma_m: float = option(0.05, gt=0, lt=1e9)
    """Standard deviation per axis of absolute positions; of odometry: after one second, growing with the root
    of time"""
    orientation_sigma_deg: float = option(1.0, gt=0, lt=1e9)
    """Standard deviation per axis of orientations, likewise"""
    time_offset_s: float = option(0.0, gt=-1e9, lt=1e9)
    """Added to the time stamps of the file"""
    time_unit: str = time_unit_option()
    max_gap_s: float = option(0.5, gt=0, lt=1e9)
    """Poses of the file are not interpolated over longer gaps"""
    sensor_id: str = ""
    """Sensor or camera of the map whose poses the file has; empty = the IMU"""
    times_file: Path | None = None
    """Time stamps of a KITTI trajectory, one per line (times.txt)"""
    align: bool = True
    """Move the base frame of the mission by yaw and position so that it fits the absolute poses"""
    replace: bool = False
    """Replace the measurements of the same kind that the mission has"""


class GpsOptions(Options, prefix="gps_"):
    """Use of the positions of a satellite receiver."""

    sigma_m: float = option(1.0, gt=0, lt=1e9)
    """Standard deviation of east and of north"""
    sigma_vertical_m: float = option(0.0, ge=0, lt=1e9)
    """Standard deviation of the altitude; 0 = twice that of east"""
    lever_arm_m: str = "0,0,0"
    """Position x,y,z of the antenna on the IMU"""
    time_offset_s: float = option(0.0, gt=-1e10, lt=1e10)
    """Added to the time stamps of the file"""
    time_unit: str = time_unit_option()
    max_gap_s: float = option(2.0, gt=0, lt=1e9)
    """Fixes between vertices that are further apart are left out"""
    origin: str = ""
    """Origin of east, north and up: latitude,longitude [deg],ellipsoidal altitude [m]; empty = that of the
    map, or else the median of the fixes"""
    date: str = ""
    """Day of the first fix as YYYY-MM-DD, for NMEA files without RMC and ZDA sentences"""
    topic: str = ""
    """Topic of a bag with sensor_msgs/NavSatFix; empty = the only one"""
    align: bool = True
    """Move the base frame of the mission by yaw and position so that it fits the fixes"""
    replace: bool = False
    """Replace the absolute poses that the mission has"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.lever_arm, self.given_origin

    @property
    def lever_arm(self) -> tuple[float, float, float]:
        """Position of the antenna on the IMU [m]."""
        return _three("gps_lever_arm_m", self.lever_arm_m)

    @property
    def given_origin(self) -> tuple[float, float, float] | None:
        """Latitude, longitude and altitude of the origin, None when it is not given."""
        if not self.origin.strip():
            return None
        lat, lon, alt = _three("gps_origin", self.origin)
        if abs(lat) > 90.0 or abs(lon) > 180.0:
            raise FlagError(f"--gps_origin={self.origin}: wants latitude and longitude in degrees")
        return lat, lon, alt

    def shifted(self, times_ns: I64) -> I64:
        """Return stamps (N,) on the clock of the map."""
        return times_ns + round(self.time_offset_s * 1e9)


class WheelOptions(Options, prefix="wheel_"):
    """Uncertainty of wheel odometry, and the pose of its sensor."""

    position_sigma_m: float = option(0.02, gt=0, lt=1e9)
    """Standard deviation along and across after one metre, growing with the root of the distance"""
    yaw_sigma_deg: float = option(0.5, gt=0, lt=1e9)
    """Standard deviation of the heading, likewise"""
    vertical_sigma_m: float = option(0.05, gt=0, lt=1e9)
    """Standard deviation of height, likewise, where the file has none"""
    tilt_sigma_deg: float = option(2.0, gt=0, lt=1e9)
    """Standard deviation of roll and pitch, likewise, where the file has none"""
    sensor_id: str = ""
    """Sensor WHEEL_ODOMETRY of sensors.yaml, of which extrinsics and covariance are taken; empty = a new
    one"""
    position_m: str = "0,0,0"
    """Position x,y,z of a new sensor, the middle of the axle, on the IMU"""
    orientation_xyzw: str = "0,0,0,1"
    """Orientation of a new sensor on the IMU as a quaternion x,y,z,w; its x points forwards, its z upwards"""
    time_offset_s: float = option(0.0, gt=-1e10, lt=1e10)
    """Added to the time stamps of the file"""
    time_unit: str = time_unit_option()
    max_gap_s: float = option(0.5, gt=0, lt=1e9)
    """Rows of the file are not interpolated over longer gaps"""
    replace: bool = False
    """Replace the wheel odometry edges that the mission has"""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.T_I_S

    @property
    def T_I_S(self) -> F64:
        """Mounting (7,) of a new sensor on the IMU."""
        q = np.array(_numbers("wheel_orientation_xyzw", self.orientation_xyzw, 4))
        length = float(np.linalg.norm(q))
        if not abs(length - 1.0) < _UNIT_TOLERANCE:
            raise FlagError(
                f"--wheel_orientation_xyzw={self.orientation_xyzw}: a quaternion of length 1 is wanted, not "
                f"{length:g}"
            )
        return se3.make(q / length, np.array(_three("wheel_position_m", self.position_m)))


def _three(flag: str, text: str) -> tuple[float, float, float]:
    x, y, z = _numbers(flag, text, 3)
    return x, y, z


def _numbers(flag: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.all(np.isfinite(values)):
        words = {3: "three", 4: "four"}[count]
        example = {3: "0.1,0,-0.05", 4: "0,0,0.707,0.707"}[count]
        raise FlagError(
            f"--{flag}={text}: wants {words} numbers separated by commas, as in {example}"
        )
    return values


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
