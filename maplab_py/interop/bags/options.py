"""Options of the commands of bags."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from maplab_py.errors import FlagError
from maplab_py.options import option

CONTENTS = ("poses", "path", "odometry", "tf", "imu", "images", "depth", "clouds")
FORMATS = ("ros1", "sqlite3", "mcap")
_HIGHEST_RATE_HZ = 1e9


@dataclasses.dataclass(frozen=True)
class PoseToBagOptions:
    """Poses to add to a bag, and the names of their frames."""

    flag_prefix: ClassVar[str] = "rosbag_plugin_pose_to_bag_"

    world_frame: str = option("map", help="Name of the global frame G")
    odom_frame: str = option("mission", help="Name of the frame M of the mission")
    base_frame: str = option("imu", help="Name of the body frame I")
    add_tf: bool = option(True, help="Add the poses to /tf")
    add_transform_stamped: bool = option(
        True, help="Add the poses as the topics T_G_I, T_M_I and T_G_M"
    )
    interpolate_to_frequency_hz: float = option(
        100.0, help="Rate of the poses between vertices, if higher than theirs", unit="Hz"
    )
    drop_tf: bool = option(False, help="Leave /tf of the input out")

    def __post_init__(self) -> None:
        """Check the rate."""
        if not 0.0 < self.interpolate_to_frequency_hz <= _HIGHEST_RATE_HZ:
            raise ValueError(
                "--rosbag_plugin_pose_to_bag_interpolate_to_frequency_hz must be positive and at most 1e9"
            )


@dataclasses.dataclass(frozen=True)
class BagExportOptions:
    """Content to write, and its format."""

    flag_prefix: ClassVar[str] = "bag_"

    format: str = option(
        "",
        help="ROS 1, or ROS 2 with sqlite3 or mcap; empty = ROS 1 for files .bag, else mcap",
        choices=("", *FORMATS),
    )
    content: str = option(
        ",".join(CONTENTS), help="What is written, separated by commas, where the map has it"
    )
    world_frame: str = option("map", help="Name of the global frame G")
    odom_frame: str = option("mission", help="Name of the frame M of the mission")
    base_frame: str = option("imu", help="Name of the body frame I")

    @property
    def contents(self) -> tuple[str, ...]:
        """The parts that are written.

        Raises:
            FlagError: A part is unknown.
        """
        words = tuple(word.strip() for word in self.content.split(",") if word.strip())
        unknown = [word for word in words if word not in CONTENTS]
        if unknown or not words:
            raise FlagError(
                f"--bag_content={self.content}: wants some of {', '.join(CONTENTS)}, separated by commas"
            )
        return words


@dataclasses.dataclass(frozen=True)
class BagImportOptions:
    """Choice of the messages that become resources."""

    resource_topic: str = option("", help="Topic of images, depth images or point clouds")
    resource_time_offset_ns: int = option(
        0,
        help="Is added to the stamps of the topic, beside the time offset of the camera",
        unit="ns",
    )
    camera_calibration_topic: str = option(
        "",
        help="Topic of CameraInfo that the camera of the map is compared with; empty = no comparison",
    )
    calibration_tolerance_px: float = option(
        1.0, help="Largest difference between the two calibrations", unit="px"
    )
    camera: int = option(
        -1, help="Index of the camera in its rig; -1 = the one of that topic, or the only one"
    )
    sensor_id: str = option("", help="Sensor of point clouds; empty = the mission's lidar")
    image_tolerance_ms: float = option(
        1.0, help="Largest difference between the times of message and frame", unit="ms"
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.image_tolerance_ms < 0.0 or self.calibration_tolerance_px < 0.0 or self.camera < -1:
            raise ValueError(
                "--image_tolerance_ms and --calibration_tolerance_px must be 0 or greater, --camera -1 or "
                "greater"
            )
