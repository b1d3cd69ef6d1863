"""Options and reports of maps in bags."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from maplab_py.errors import FlagError
from maplab_py.options import Options, option
from maplab_py.report import Report

CONTENTS = ("poses", "path", "odometry", "tf", "imu", "images", "depth", "clouds")
FORMATS = ("ros1", "sqlite3", "mcap")


class PoseToBagOptions(Options, prefix="rosbag_plugin_pose_to_bag_"):
    """Poses to add to a bag, and the names of their frames."""

    world_frame: str = "map"
    """Name of the global frame G"""
    odom_frame: str = "mission"
    """Name of the frame M of the mission"""
    base_frame: str = "imu"
    """Name of the body frame I"""
    add_tf: bool = True
    """Add the poses to /tf"""
    add_transform_stamped: bool = True
    """Add the poses as the topics T_G_I, T_M_I and T_G_M"""
    interpolate_to_frequency_hz: float = option(100.0, gt=0, le=1e9)
    """Rate of the poses between vertices, if higher than theirs"""
    drop_tf: bool = False
    """Leave /tf of the input out"""


class BagExportOptions(Options, prefix="bag_"):
    """Content to write, and its format."""

    format: str = option("", choices=("", *FORMATS))
    """ROS 1, or ROS 2 with sqlite3 or mcap; empty = ROS 1 for files .bag, else mcap"""
    content: str = ",".join(CONTENTS)
    """Parts to write, separated by commas, where the map has them"""
    world_frame: str = "map"
    """Name of the global frame G"""
    odom_frame: str = "mission"
    """Name of the frame M of the mission"""
    base_frame: str = "imu"
    """Name of the body frame I"""

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


class BagImportOptions(Options):
    """Choice of the messages that become resources."""

    resource_topic: str = ""
    """Topic of images, depth images or point clouds"""
    resource_time_offset_ns: int = 0
    """Is added to the stamps of the topic, beside the time offset of the camera"""
    camera_calibration_topic: str = ""
    """Topic of CameraInfo that the camera of the map is compared with; empty = no comparison"""
    calibration_tolerance_px: float = option(1.0, ge=0)
    """Largest difference between the two calibrations"""
    camera: int = option(-1, ge=-1)
    """Index of the camera in its rig; -1 = the one of that topic, or the only one"""
    sensor_id: str = ""
    """Sensor of point clouds; empty = the mission's lidar"""
    image_tolerance_ms: float = option(1.0, ge=0)
    """Largest difference between the times of message and frame"""


@dataclasses.dataclass(frozen=True)
class WrittenTopic:
    """A topic of a bag that was written."""

    topic: str
    messages: int


class BagReport(Report):
    """A bag that was written."""

    bag: Path
    format: str
    missions: tuple[str, ...]
    messages: int
    copied_messages: int
    topics: tuple[WrittenTopic, ...]
    notes: tuple[str, ...] = ()


def written_topics(counts: Mapping[str, int]) -> tuple[WrittenTopic, ...]:
    """Return the topics with their numbers of messages, by name."""
    return tuple(WrittenTopic(topic, count) for topic, count in sorted(counts.items()))


class BagImport(Report):
    """Messages that became resources of a mission; their files are written when the map is saved."""

    mission: str
    topic: str
    type: str
    messages: int
    resource_types: tuple[str, ...]
    attached: int
    had_some: int = dataclasses.field(
        metadata={"title": "with a resource before"}
    )  # frames or clouds
    frames_without_message: int = 0
    messages_outside_mission: int = 0
    camera: int | None = None
    calibration_difference_px: float | None = None
    notes: tuple[str, ...] = ()
