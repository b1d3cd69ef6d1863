"""Options of a run over a recording, with rovioli's flag names."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np

from maplab_py.errors import FlagError
from maplab_py.frontend.localization.options import OnlineLocalizationOptions
from maplab_py.frontend.odometry_options import OdometryOptions
from maplab_py.interop.live.options import TRANSPORTS
from maplab_py.interop.recordings.options import StreamOptions
from maplab_py.options import option

DATA_SOURCES = ("auto", "euroc", "rosbag", "map", *TRANSPORTS)


@dataclasses.dataclass(frozen=True)
class DataSourceOptions:
    """Recording to read."""

    flag_prefix: ClassVar[str] = "datasource_"

    type: str = option(
        "auto",
        choices=DATA_SOURCES,
        help="euroc = EuRoC or TUM-VI folder, rosbag = ROS 1 or ROS 2 bag, map = replay of the tracks "
        "and IMU samples of a mission, ros2, ros1 or foxglove = topics of a running robot, auto = what "
        "the path is",
    )
    rosbag: Path | None = option(None, help="Bag to read (datasource_type=rosbag)")
    map_mission: str = option(
        "", help="Mission to replay (datasource_type=map); empty = the only one", flag="map_mission"
    )


@dataclasses.dataclass(frozen=True)
class MapBuilderOptions:
    """Choice of the frames that become vertices, and their content."""

    flag_prefix: ClassVar[str] = ""

    nframe_sync_max_output_frequency_hz: float = option(
        10.0,
        help="Largest rate of the vertices of the map",
        unit="Hz",
        flag="vio_nframe_sync_max_output_frequency_hz",
    )
    save_image_as_resources: bool = option(
        False,
        help="Keep the images of the vertices as resources of the map",
        flag="map_builder_save_image_as_resources",
    )

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: The rate is not positive.
        """
        rate = self.nframe_sync_max_output_frequency_hz
        if not 0.0 < rate < np.inf:
            raise FlagError(
                f"--vio_nframe_sync_max_output_frequency_hz={rate:g}: must be greater than 0"
            )


@dataclasses.dataclass(frozen=True)
class OutputOptions:
    """Outputs of a run, and their places."""

    flag_prefix: ClassVar[str] = ""

    save_map_folder: Path | None = option(
        None, help="Folder of the map; empty = the map stays in memory"
    )
    overwrite_existing_map: bool = option(
        False, help="Replace a map in --save_map_folder, and a file of poses"
    )
    run_map_builder: bool = option(
        True,
        help="Build a map; without, only the poses are estimated",
        flag="rovioli_run_map_builder",
    )
    optimize_map_to_localization_map: bool = option(
        False,
        help="Turn the map into a localisation map: keyframes, loop closure, optimisation",
    )
    localization_map_keep_landmark_fraction: float = option(
        0.0, help="Share of the good landmarks that the localisation map keeps; 0 = all"
    )
    export_estimated_poses_to_csv: Path | None = option(
        None, help="Write the states of all frames, as estimated at their time, in EuRoC's form"
    )

    export_localized_poses_to_csv: Path | None = option(
        None,
        help="Write the poses of all frames in the map and in the mission, T_G_M, velocities and "
        "biases, as estimated at their time; needs --vio_localization_map_folder",
    )

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: Options contradict each other, or the share is not in [0, 1].
        """
        share = self.localization_map_keep_landmark_fraction
        if not 0.0 <= share <= 1.0:
            raise FlagError(f"--localization_map_keep_landmark_fraction={share:g}: wants 0 to 1")
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


@dataclasses.dataclass(frozen=True)
class RunOptions:
    """Options of a run over a recording."""

    flag_prefix: ClassVar[str] = ""

    stream: StreamOptions = StreamOptions()
    odometry: OdometryOptions = OdometryOptions()
    builder: MapBuilderOptions = MapBuilderOptions()
    output: OutputOptions = OutputOptions()
    localization: OnlineLocalizationOptions = OnlineLocalizationOptions()
    realtime_playback_rate: float = option(
        0.0,
        help="Read the recording at this multiple of real time; 0 = as fast as possible",
        flag="vio_rosbag_realtime_playback_rate",
    )
    enable_health_checking: bool = option(
        False,
        help="Print speed, uncertainty and biases every second",
        flag="rovioli_enable_health_checking",
    )

    def check(self) -> None:
        """Check the values.

        Raises:
            FlagError: A value is out of its range.
        """
        self.stream.check()
        self.odometry.check()
        self.builder.check()
        self.output.check()
        self.localization.check()
        is_localized = self.localization.map_folder is not None
        if self.output.export_localized_poses_to_csv is not None and not is_localized:
            raise FlagError("--export_localized_poses_to_csv needs --vio_localization_map_folder")
        if not 0.0 <= self.realtime_playback_rate < 1e6:
            raise FlagError(
                f"--vio_rosbag_realtime_playback_rate={self.realtime_playback_rate:g}: wants 0 "
                "or more"
            )
