"""Options and reports of the map server."""

import dataclasses
from pathlib import Path

from maplab_py.options import Options, option
from maplab_py.report import Report


class SubmapOptions(Options):
    """Preparation of a submap before it is merged."""

    remove_outliers_in_absolute_pose_constraints: bool = True
    """Leave out absolute poses that contradict their neighbours (see optvi)."""
    stationary_submaps_fix_with_lc_edge: bool = False
    """Tie the first and the last vertex of a submap that stands still by a loop closure edge."""
    submap_loading_thread_pool_size: int = option(4, ge=1)
    """Submaps that are prepared at the same time, each in a process."""


class MergingOptions(Options):
    """Merging of submaps into one map."""

    enable_visual_loop_closure: bool = True
    """Close loops within and between missions."""
    enable_lidar_loop_closure: bool = False
    """Before joint optimisations, register clouds of lidars that are near one another, and use the relative
    poses; needs the extra lidar. Clouds are registered again each time."""
    enable_visual_loop_closure_based_map_anchoring: bool = True
    """Anchor missions of unknown base frame to known ones by loop closures."""
    set_first_robot_map_baseframe_to_known: bool = True
    """The first mission of the map defines the global frame."""
    spatially_distribute_missions: bool = True
    """Set missions that are not anchored yet apart from the others."""
    preserve_trust_region_radius_across_merging: bool = True
    """A joint optimisation starts with the trust region of the one before."""
    reset_trust_region_radius_if_new_robot: bool = True
    """Not where a new robot has come since."""
    reset_trust_region_radius_every_nth_submap: int = option(0, ge=0)
    """Nor where so many submaps were merged since the last reset; 0 = never."""


class PublishingOptions(Options):
    """Destination of the map."""

    merged_map_folder: str = ""
    """Folder of the merged map, replaced after every change; required."""
    resource_folder: str = ""
    """Folder for the resources of the map; empty = the map's own."""
    backup_interval_s: int = option(300, ge=0)
    """Keep a copy of the map beside it every so often; 0 = never."""
    dense_map_resource_type: int = 21
    """Type of the resources that get_dense_map_in_range looks into (number)."""


class MapServerOptions(PublishingOptions, MergingOptions, SubmapOptions, prefix="maplab_server_"):
    """All flags of the server that maplab has, too."""


class IncrementalOptions(Options):
    """Optimisation after each submap, and of the whole map."""

    full_optimization_every_nth: int = option(10, ge=0)
    """Close all loops and optimise the whole map jointly after so many submaps, and when the server stops; 0
    = when it stops only."""
    local_free_vertices: int = option(150, ge=0)
    """Vertices besides those of a new submap that are optimised with it."""
    local_fixed_vertices: int = option(150, ge=0)
    """Vertices that are held fixed and observe landmarks of the optimised ones."""
    similar_stretches: int = option(5, ge=0)
    """Submaps that look most like a new one and are searched for loop closures."""
    near_vertices: int = option(100, ge=0)
    """Vertices nearest to a new submap that are searched for loop closures as well."""


class ServiceOptions(Options, prefix="serve_"):
    """Address of the service, and the data that the server keeps."""

    address: str = "127.0.0.1"
    """Address at which requests are answered; at another than loopback they need the token that is in
    server.json of the spool."""
    port: int = 0
    """Its port; 0 = any."""
    stop_when_idle_s: float = option(0.0, ge=0)
    """Stop after so long without anything to do; 0 = never."""
    keep_submaps: bool = True
    """Keep submaps in the spool's folder merged, so that the map can be built again."""
    save_on_shutdown: bool = True
    """At its end the server optimises jointly and publishes; otherwise it ends at once, and what it has not
    published is merged again after the next start."""
    visualization_interval_s: float = option(10.0, ge=0)
    """With --serve_visualize_map, show the published map at most every so often, and at the end; 0 = after
    every publication."""


class SubmapOutput(Options):
    """Destination of submaps while a recording is read."""

    submap_spool: Path | None = None
    """Spool of a map server that gets the map in parts; empty = none"""
    submap_interval_s: float = option(20.0, gt=0)
    """Length of a part"""
    robot_name: str = "robot"
    """Name of this robot in the spool"""


class PlayOptions(Options, prefix="robots_"):
    """Division of sessions into submaps, and their playback rate."""

    submap_s: float = option(10.0, gt=0)
    """Length of a submap."""
    rate: float = option(1.0, ge=0)
    """Speed relative to real time; 0 = push everything as fast as it can be written."""


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


class ServerStatus(Report):
    """State of a map server and its map."""

    is_running: bool = False
    spool: Path = Path()
    merged_map_folder: str = ""
    url: str = ""
    missions: int = 0
    vertices: int = 0
    landmarks: int = 0
    incoming: int = 0  # not taken yet
    preparing: int = 0
    waiting: int = 0  # for a worker, or for the submap that they adjoin
    merged: int = 0
    rejected: int = 0
    since_joint_optimization: int = 0  # submaps
    published_s_ago: float | None = None
    robots: tuple[RobotLine, ...] = ()
    last_events: tuple[EventLine, ...] = ()
    problem: str = ""


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


class DeletedMissions(Report):
    """Missions that the server has removed from its map."""

    missions: tuple[str, ...]
    vertices: int


class LookupReport(Report):
    """Position of a point of a robot's sensor in the global frame."""

    robot: str
    mission: str
    is_anchored: bool
    timestamp_ns: int
    p_G: tuple[float, float, float]
    p_G_sensor: tuple[float, float, float]


class DenseMapReport(Report):
    """Points of a dense map in a sphere."""

    points: int
    resources: int  # clouds with a point in the sphere
    output_file: Path | None = None


class PushReport(Report):
    """A submap that was put into a spool."""

    folder: Path


class PlayedRobots(Report):
    """Simulated submaps that were put into a spool."""

    robots: int
    submaps: int
    truth: Path | None  # of simulated sessions
    seconds: float
