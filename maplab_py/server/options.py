"""Options and reports of the map server."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option
from maplab_py.report import Report


@dataclasses.dataclass(frozen=True)
class SubmapOptions:
    """Preparation of a submap before it is merged."""

    remove_outliers_in_absolute_pose_constraints: bool = option(
        True, help="Leave out absolute poses that contradict their neighbours (see optvi)."
    )
    stationary_submaps_fix_with_lc_edge: bool = option(
        False,
        help="Tie the first and the last vertex of a submap that stands still by a loop closure edge.",
    )
    submap_loading_thread_pool_size: int = option(
        4, help="Submaps that are prepared at the same time, each in a process."
    )


@dataclasses.dataclass(frozen=True)
class MergingOptions:
    """Merging of submaps into one map."""

    enable_visual_loop_closure: bool = option(True, help="Close loops within and between missions.")
    enable_lidar_loop_closure: bool = option(
        False,
        help="Before joint optimisations, register clouds of lidars that are near one another, and use the "
        "relative poses; needs the extra lidar. Clouds are registered again each time.",
    )
    enable_visual_loop_closure_based_map_anchoring: bool = option(
        True, help="Anchor missions of unknown base frame to known ones by loop closures."
    )
    set_first_robot_map_baseframe_to_known: bool = option(
        True, help="The first mission of the map defines the global frame."
    )
    spatially_distribute_missions: bool = option(
        True, help="Set missions that are not anchored yet apart from the others."
    )
    preserve_trust_region_radius_across_merging: bool = option(
        True, help="A joint optimisation starts with the trust region of the one before."
    )
    reset_trust_region_radius_if_new_robot: bool = option(
        True, help="Not where a new robot has come since."
    )
    reset_trust_region_radius_every_nth_submap: int = option(
        0, help="Nor where so many submaps were merged since the last reset; 0 = never."
    )


@dataclasses.dataclass(frozen=True)
class PublishingOptions:
    """Destination of the map."""

    merged_map_folder: str = option(
        "", help="Folder of the merged map, replaced after every change; required."
    )
    resource_folder: str = option(
        "", help="Folder for the resources of the map; empty = the map's own."
    )
    backup_interval_s: int = option(
        300, help="Keep a copy of the map beside it every so often; 0 = never.", unit="s"
    )
    dense_map_resource_type: int = option(
        21, help="Type of the resources that get_dense_map_in_range looks into (number)."
    )


@dataclasses.dataclass(frozen=True)
class MapServerOptions(PublishingOptions, MergingOptions, SubmapOptions):
    """All flags of the server that maplab has, too."""

    flag_prefix: ClassVar[str] = "maplab_server_"

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            FlagError: A value is out of range.
        """
        for name in ("backup_interval_s", "reset_trust_region_radius_every_nth_submap"):
            if getattr(self, name) < 0:
                raise FlagError(f"--maplab_server_{name} must not be negative; 0 = never")
        if self.submap_loading_thread_pool_size < 1:
            raise FlagError("--maplab_server_submap_loading_thread_pool_size must be at least 1")


@dataclasses.dataclass(frozen=True)
class IncrementalOptions:
    """Optimisation after each submap, and of the whole map."""

    full_optimization_every_nth: int = option(
        10,
        help="Close all loops and optimise the whole map jointly after so many submaps, and when the "
        "server stops; 0 = when it stops only.",
    )
    local_free_vertices: int = option(
        150, help="Vertices besides those of a new submap that are optimised with it."
    )
    local_fixed_vertices: int = option(
        150, help="Vertices that are held fixed and observe landmarks of the optimised ones."
    )
    similar_stretches: int = option(
        5, help="Submaps that look most like a new one and are searched for loop closures."
    )
    near_vertices: int = option(
        100, help="Vertices nearest to a new submap that are searched for loop closures as well."
    )

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            FlagError: A value is negative.
        """
        for field in dataclasses.fields(self):
            if getattr(self, field.name) < 0:
                raise FlagError(f"--{field.name} must not be negative")


@dataclasses.dataclass(frozen=True)
class ServiceOptions:
    """Address of the service, and the data that the server keeps."""

    flag_prefix: ClassVar[str] = "serve_"

    address: str = option(
        "127.0.0.1",
        help="Address at which requests are answered; at another than loopback they need the token "
        "that is in server.json of the spool.",
    )
    port: int = option(0, help="Its port; 0 = any.")
    stop_when_idle_s: float = option(
        0.0, help="Stop after so long without anything to do; 0 = never.", unit="s"
    )
    keep_submaps: bool = option(
        True, help="Keep submaps in the spool's folder merged, so that the map can be built again."
    )
    save_on_shutdown: bool = option(
        True,
        help="At its end the server optimises jointly and publishes; otherwise it ends at once, and what it "
        "has not published is merged again after the next start.",
    )
    visualization_interval_s: float = option(
        10.0,
        help="With --serve_visualize_map, show the published map at most every so often, and at the end; "
        "0 = after every publication.",
        unit="s",
    )

    def __post_init__(self) -> None:
        """Check the times.

        Raises:
            FlagError: One is negative.
        """
        for name in ("stop_when_idle_s", "visualization_interval_s"):
            if not getattr(self, name) >= 0.0:
                raise FlagError(f"--serve_{name} must not be negative")


@dataclasses.dataclass(frozen=True)
class SubmapOutput:
    """Destination of submaps while a recording is read."""

    flag_prefix: ClassVar[str] = ""

    submap_spool: Path | None = option(
        None, help="Spool of a map server that gets the map in parts; empty = none"
    )
    submap_interval_s: float = option(20.0, help="Length of a part", unit="s")
    robot_name: str = option("robot", help="Name of this robot in the spool")

    def __post_init__(self) -> None:
        """Check the interval.

        Raises:
            FlagError: It is not positive.
        """
        if not self.submap_interval_s > 0.0:
            raise FlagError(f"--submap_interval_s={self.submap_interval_s:g}: must be positive")


@dataclasses.dataclass(frozen=True)
class PlayOptions:
    """Division of sessions into submaps, and their playback rate."""

    flag_prefix: ClassVar[str] = "robots_"

    submap_s: float = option(10.0, help="Length of a submap.", unit="s")
    rate: float = option(
        1.0, help="Speed relative to real time; 0 = push everything as fast as it can be written."
    )

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            FlagError: A value is out of range.
        """
        if not self.submap_s > 0.0:
            raise FlagError(f"--robots_submap_s={self.submap_s:g}: must be greater than 0")
        if not 0.0 <= self.rate < float("inf"):
            raise FlagError(f"--robots_rate={self.rate:g}: must be 0 or greater")


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
