"""Interface of the readers of recordings.

All times of items and events are nanoseconds of the IMU's clock: the stamp of an image plus
the time offset of its camera (t_imu = t_camera + offset).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Protocol

from maplab_py.array_types import F64, I32, I64, U8, Mask, Rows
from maplab_py.interop.device import RecordedSensors as RecordedSensors
from maplab_py.interop.images import CONTAINER_BITS, Pixels, as_grey
from maplab_py.sensors import Imu
from maplab_py.vimap.descriptors import DescriptorDepth, FeatureType


class ImuBatch(Rows):
    """Consecutive IMU samples, at least one, in the order of time."""

    times_ns: I64  # (N,)
    accel_gyro: F64  # (N, 6) [ax ay az gx gy gz], m/s^2 and rad/s, as measured
    is_saturated: Mask  # (N,) some axis reached the limit of the sensor

    @classmethod
    def of(cls, imu: Imu, times_ns: I64, accel_gyro: F64) -> ImuBatch:
        """Make a batch; saturation follows from the limits of the IMU."""
        return cls(times_ns, accel_gyro, imu.is_saturated(accel_gyro))

    @property
    def time_ns(self) -> int:
        """Time of the first sample."""
        return int(self.times_ns[0])


class ImageData(Protocol):
    """The content of an image before it is decoded."""

    @property
    def encoding(self) -> str:
        """Name of the encoding."""

    @property
    def bits(self) -> int:
        """Bits of a value; 0 = only the values tell."""

    def size_px(self) -> tuple[int, int]:
        """Return width and height as recorded.

        Raises:
            MapError: The image cannot be read.
        """

    def check(self) -> None:
        """Check size and completeness without decoding.

        Raises:
            MapError: The image is missing, truncated or of another size than its camera's images.
        """

    def decode(self) -> Pixels:
        """Return the pixels as recorded: (H, W) grey or (H, W, 3) BGR, 8 or 16 bits.

        Raises:
            MapError: As `check`, or the image is damaged.
        """


@dataclasses.dataclass(frozen=True, eq=False)
class CameraImage:
    """One image; its pixels are read and decoded each time they are asked for."""

    camera: int  # row of the rig's cameras
    time_ns: int  # in the clock of the IMU
    stamp_ns: int  # as recorded, in the clock of the camera
    data: ImageData
    bits: int = CONTAINER_BITS  # of the camera's values, where they are stored in 16

    def decode(self) -> Pixels:
        """Return the pixels as recorded; see `ImageData.decode`."""
        return self.data.decode()

    def grey(self) -> U8:
        """Return 8-bit grey values (H, W); of more bits the upper eight, of colours the luminance."""
        return as_grey(self.decode(), self.bits)


@dataclasses.dataclass(frozen=True, eq=False)
class FrameSet:
    """Images of all cameras of the rig, taken at the same time within the tolerance."""

    time_ns: int  # of the first camera's image
    images: tuple[CameraImage, ...]  # by camera


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Keypoints of one image with the tracks they belong to."""

    camera: int
    stamp_ns: int
    uv_px: F64  # (K, 2) of the distorted image
    sigma_px: F64  # (K,)
    scale: F64  # (K,)
    track_id: I32  # (K,) -1 = on no track
    descriptor: U8  # (K, width) as wide as the widest
    descriptor_size: I32  # (K,) bytes of each descriptor, 0 where there is none
    feature_type: int = FeatureType.BINARY
    depth: int = DescriptorDepth.UINT8


@dataclasses.dataclass(frozen=True, eq=False)
class TrackedFrameSet:
    """Tracked keypoints of a rig at one time, in place of images."""

    time_ns: int
    frames: tuple[TrackedFrame | None, ...]  # by camera, None where the camera has no frame


@dataclasses.dataclass(frozen=True)
class PartSpan:
    """A part of a recording between two starts of its clock."""

    part: int  # from 1, as --recording_part takes it
    start_ns: int
    duration_s: float
    imu_samples: int
    images: int


Item = ImuBatch | CameraImage | TrackedFrameSet
"""Items that readers yield, in the order of time."""

Event = ImuBatch | FrameSet | TrackedFrameSet
"""Items that `EventStream` yields, in the order of time."""


class Recording(Protocol):
    """A reader of one recording; it can be read several times."""

    @property
    def name(self) -> str:
        """File or folder, for messages and reports."""

    @property
    def kind(self) -> str:
        """Kind of the recording, as in "EuRoC folder"."""

    @property
    def device(self) -> RecordedSensors:
        """The calibrated sensors."""

    @property
    def start_ns(self) -> int:
        """Time of the first item."""

    @property
    def end_ns(self) -> int:
        """Approximate time of the last item, for the progress of readers; 0 = not known."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user: parts of the recording that are not read."""

    def parts(self) -> tuple[PartSpan, ...]:
        """Return the parts into which restarts of the clock divide the recording."""

    def items(self, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Item]:
        """Yield what was recorded at start_ns or later and before end_ns, in the order of time.

        Raises:
            MapError: Files are missing or damaged, or stamps run backwards.
        """
