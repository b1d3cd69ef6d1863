"""Messages of running robots: headers of TCPROS, IMU samples and images of ROS 1 and in CDR."""

from pathlib import Path

import numpy as np

from maplab_py.interop.live import ros1, source
from maplab_py.interop.recordings import bag_files, protocol
from maplab_py.sensors import Camera, Distortion, Projection
from tests.interop.recordings.written import (
    HEIGHT,
    INTRINSICS,
    START_NS,
    WIDTH,
    image_message,
    imu_message,
    make_content,
)

_CAMERA = Camera(
    "", Projection.PINHOLE, Distortion.NONE, np.array(INTRINSICS), np.zeros(0), WIDTH, HEIGHT
)
_IMAGE_KIND = "sensor_msgs/msg/Image"


def message_seeds(folder: Path) -> list[bytes]:
    """Return a TCPROS header (first byte 0), IMU samples (1, 2) and images (3, 4) of ROS 1 and CDR."""
    content = make_content(cameras=1, frames=1)
    seeds = [b"\0" + ros1.header_bytes({"topic": "/imu0", "md5sum": "*"})[4:]]
    for version in (1, 2):
        store = bag_files.message_types(is_ros_2=version == 2)
        serialize = store.serialize_cdr if version == 2 else store.serialize_ros1
        imu = imu_message(store, START_NS, content.accel_gyro[0], version)
        image = image_message(store, START_NS, content.images[0][0], "mono8", version)
        seeds.append(bytes([version]) + bytes(serialize(imu, imu.__msgtype__)))
        seeds.append(bytes([version + 2]) + bytes(serialize(image, image.__msgtype__)))
    return seeds


def read_message(folder: Path, data: bytes) -> None:
    """Read one message; no file is written."""
    kind, body = data[:1] or b"\0", data[1:]
    is_ros_2 = kind[0] % 2 == 0
    if kind[0] in (1, 2):
        source.imu_values(body, is_ros_2=is_ros_2)
    elif kind[0] in (3, 4):
        store = bag_files.message_types(is_ros_2=is_ros_2)
        image = source.image_data(body, _IMAGE_KIND, _CAMERA, "image", store, is_ros_2=is_ros_2)
        protocol.CameraImage(0, 0, 0, image).grey()
    else:
        ros1.parse_header(body)
