"""Options of a run over a recording, with rovioli's flag names."""

from pathlib import Path

from maplab_py.algorithms.map_update.options import EvidenceOptions
from maplab_py.errors import FlagError
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.live.options import TRANSPORTS
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.options import Options, option
from maplab_py.vision.features.options import NETWORKS

DATA_SOURCES = ("auto", "euroc", "rosbag", "map", *TRANSPORTS)


class DataSourceOptions(Options, prefix="datasource_"):
    """Recording to read."""

    type: str = option("auto", choices=DATA_SOURCES)
    """euroc = EuRoC or TUM-VI folder, rosbag = ROS 1 or ROS 2 bag, map = replay of the tracks and IMU samples
    of a mission, ros2, ros1 or foxglove = topics of a running robot, auto = what the path is"""
    rosbag: Path | None = None
    """Bag to read (datasource_type=rosbag)"""
    map_mission: str = option("", flag="map_mission")
    """Mission to replay (datasource_type=map); empty = the only one"""


class MapBuilderOptions(Options):
    """Choice of the frames that become vertices, and their content."""

    nframe_sync_max_output_frequency_hz: float = option(
        10.0, gt=0, flag="vio_nframe_sync_max_output_frequency_hz"
    )
    """Largest rate of the vertices of the map"""
    save_image_as_resources: bool = option(False, flag="map_builder_save_image_as_resources")
    """Keep the images of the vertices as resources of the map"""
    features_every: int = option(1, ge=1, flag="vio_localization_features_every")
    """Vertices from one that a network describes to the next, in a thread; those between get brisk"""


class OutputOptions(Options):
    """Outputs of a run, and their places."""

    save_map_folder: Path | None = None
    """Folder of the map; empty = the map stays in memory"""
    overwrite_existing_map: bool = False
    """Replace a map in --save_map_folder, and a file of poses"""
    run_map_builder: bool = option(True, flag="rovioli_run_map_builder")
    """Build a map; without, only the poses are estimated"""
    optimize_map_to_localization_map: bool = False
    """Turn the map into a localisation map: keyframes, loop closure, optimisation"""
    localization_map_keep_landmark_fraction: float = option(0.0, ge=0, le=1)
    """Share of the good landmarks that the localisation map keeps; 0 = all"""
    export_estimated_poses_to_csv: Path | None = None
    """Write the states of all frames, as estimated at their time, in EuRoC's form"""

    export_localized_poses_to_csv: Path | None = None
    """Write the poses of all frames in the map and in the mission, T_G_M, velocities and biases, as estimated
    at their time; needs --vio_localization_map_folder"""

    def __post_init__(self) -> None:
        super().__post_init__()
        share = self.localization_map_keep_landmark_fraction
        if share and not self.optimize_map_to_localization_map:
            raise FlagError(
                "--localization_map_keep_landmark_fraction needs --optimize_map_to_localization_map"
            )
        if self.run_map_builder:
            return
        for flag, is_given in (
            ("save_map_folder", self.save_map_folder is not None),
            ("optimize_map_to_localization_map", self.optimize_map_to_localization_map),
        ):
            if is_given:
                raise FlagError(f"--{flag} needs a map: leave --rovioli_run_map_builder=false out")


class RunOptions(Options):
    """Options of a run over a recording."""

    stream: StreamOptions = StreamOptions()
    odometry: OdometryOptions = OdometryOptions()
    builder: MapBuilderOptions = MapBuilderOptions()
    output: OutputOptions = OutputOptions()
    localization: OnlineLocalizationOptions = OnlineLocalizationOptions()
    evidence: EvidenceOptions = EvidenceOptions()
    realtime_playback_rate: float = option(
        0.0, ge=0, lt=1e6, flag="vio_rosbag_realtime_playback_rate"
    )
    """Read the recording at this multiple of real time; 0 = as fast as possible"""
    enable_health_checking: bool = option(False, flag="rovioli_enable_health_checking")
    """Print speed, uncertainty and biases every second"""

    def __post_init__(self) -> None:
        super().__post_init__()
        is_localized = self.localization.map_folder is not None
        if self.output.export_localized_poses_to_csv is not None and not is_localized:
            raise FlagError("--export_localized_poses_to_csv needs --vio_localization_map_folder")
        features = self.localization.features or self.odometry.tracking.descriptor_type
        if self.builder.features_every > 1 and features not in NETWORKS:
            raise FlagError(
                f"--vio_localization_features_every={self.builder.features_every}: a network describes "
                "vertices only with --vio_localization_features=xfeat"
            )
