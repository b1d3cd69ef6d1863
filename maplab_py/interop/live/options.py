"""Options of connections to running robots."""

import os

from maplab_py.errors import FlagError
from maplab_py.options import Options, option

TRANSPORTS = ("ros2", "ros1", "foxglove")
_HIGHEST_DOMAIN = 232
_DEFAULT_MASTER = "http://127.0.0.1:11311"


class NetworkOptions(Options):
    """Place of the topics."""

    ros_domain_id: int | None = None
    """Domain of ROS 2; empty = ROS_DOMAIN_ID of the environment, else 0"""
    ros_master_uri: str = option(
        "",
        help=f"Master of ROS 1; empty = ROS_MASTER_URI of the environment, else {_DEFAULT_MASTER}",
    )
    foxglove_url: str = "ws://127.0.0.1:8765"
    """WebSocket of foxglove_bridge, or of what speaks its protocol"""
    live_interface: str = ""
    """Network interface or IP address to listen on; empty = this computer only (loopback)"""
    live_wait_s: float = option(10.0, gt=0, lt=1e9)
    """Wait so long for the first publishers"""

    @property
    def domain(self) -> int:
        """Domain of ROS 2.

        Raises:
            FlagError: It is none.
        """
        text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
        source = "--ros_domain_id" if self.ros_domain_id is not None else "ROS_DOMAIN_ID"
        value = str(self.ros_domain_id) if self.ros_domain_id is not None else text
        if not value.isdecimal() or int(value) > _HIGHEST_DOMAIN:
            raise FlagError(f"{source}={value}: a domain is a number from 0 to {_HIGHEST_DOMAIN}")
        return int(value)

    @property
    def master(self) -> str:
        """Address of the ROS 1 master."""
        return self.ros_master_uri or os.environ.get("ROS_MASTER_URI", "") or _DEFAULT_MASTER


class LiveOptions(Options, prefix="live_"):
    """Reading of a live source, and publishing."""

    silence_s: float = option(10.0, ge=0, lt=1e9)
    """End when nothing has arrived for so long; 0 = only Ctrl-C ends"""
    max_delay_s: float = option(1.0, gt=0, lt=1e9)
    """Leave out the oldest images when they have waited longer than this; IMU samples are never left out"""
    publish: bool = True
    """Publish /maplab/odometry, /maplab/pose_in_map and /tf where the images come from"""
    publish_landmarks: bool = False
    """Publish the landmarks of the window as /maplab/landmarks (PointCloud2), too"""
    world_frame: str = "map"
    """Name of the global frame G in what is published"""
    odom_frame: str = "odom"
    """Name of the frame M of the mission in what is published"""
    base_frame: str = "imu"
    """Name of the body frame I in what is published"""
