"""Messages as they arrive: decoded with the functions that bags use, damage told as such."""

from __future__ import annotations

import collections
import math
import struct
from typing import Any

from maplab_py.errors import MapError
from maplab_py.interop.live.transport import MAX_MESSAGE_BYTES
from maplab_py.interop.recordings.bag_files import imu_sample
from maplab_py.interop.recordings.images import image_of_message
from maplab_py.interop.recordings.protocol import ImageData
from maplab_py.sensors import Camera

Sample = tuple[float, ...]
_GYRO, _ACCEL = 0, 1  # of two joined topics, in this order
_HISTORY = 400


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


class PairedImu:
    """Joins a topic of the gyroscope with one of the accelerometer; each has its own times.

    The accelerometer's values are interpolated at the times of the gyroscope.
    """

    def __init__(self) -> None:
        """Start without samples."""
        self._gyro: collections.deque[tuple[int, Sample]] = collections.deque(maxlen=_HISTORY)
        self._accel: collections.deque[tuple[int, Sample]] = collections.deque(maxlen=_HISTORY)

    def add(self, part: int, time_ns: int, values: Sample) -> list[tuple[int, Sample]]:
        """Take a message of the gyroscope (part 0) or accelerometer (1); return joined samples."""
        if part == _GYRO:
            self._gyro.append((time_ns, values[3:]))
        else:
            self._accel.append((time_ns, values[:3]))
        joined = []
        while self._gyro and self._accel and self._gyro[0][0] <= self._accel[-1][0]:
            gyro_ns, gyro = self._gyro.popleft()
            while len(self._accel) > 1 and self._accel[1][0] <= gyro_ns:
                self._accel.popleft()
            if self._accel[0][0] > gyro_ns:
                continue  # before the first of the accelerometer
            joined.append((gyro_ns, (*self._accel_at(gyro_ns), *gyro)))
        return joined

    def _accel_at(self, time_ns: int) -> Sample:
        before_ns, before = self._accel[0]
        if len(self._accel) == 1 or before_ns == time_ns:
            return before
        after_ns, after = self._accel[1]
        share = (time_ns - before_ns) / (after_ns - before_ns)
        return tuple(a + share * (b - a) for a, b in zip(before, after, strict=True))
