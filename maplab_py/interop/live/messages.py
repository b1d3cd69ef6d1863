"""Messages as they arrive: decoded with the functions that bags use, damage told as such."""

from __future__ import annotations

import math
import struct
from typing import Any

from maplab_py.errors import MapError
from maplab_py.interop.live.transport import MAX_MESSAGE_BYTES
from maplab_py.interop.recordings.bag_files import imu_sample
from maplab_py.interop.recordings.images import image_of_message
from maplab_py.interop.recordings.paired_imu import Sample
from maplab_py.interop.recordings.protocol import ImageData
from maplab_py.sensors import Camera


def imu_values(data: bytes, *, is_ros_2: bool) -> Sample:
    """Return [ax ay az gx gy gz] of a serialised sensor_msgs/Imu.

    Raises:
        MapError: The message is damaged, or a value is not a number.
    """
    try:
        values = imu_sample(data, is_ros_2=is_ros_2)
    except (struct.error, IndexError) as error:
        raise MapError("the message is damaged") from error
    if not all(map(math.isfinite, values)):
        raise MapError("a value is not a number")
    return values


def image_data(
    data: bytes, kind: str, camera: Camera, name: str, store: Any, *, is_ros_2: bool
) -> ImageData:
    """Return the image of a serialised message.

    Args:
        data: Message.
        kind: Its type, one of `IMAGE_TYPES`.
        camera: Camera that took it.
        name: What messages call it.
        store: Definitions of messages.
        is_ros_2: CDR, else ROS 1.

    Raises:
        MapError: The message is damaged.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise MapError(f"{name}: the message has {len(data):,} bytes: refused")
    decode = store.deserialize_cdr if is_ros_2 else store.deserialize_ros1
    try:
        message = decode(data, kind)
    except Exception as error:  # the parser's own, of any type
        raise MapError(f"{name}: the message is damaged: check its publisher") from error
    return image_of_message(message, name, camera)
