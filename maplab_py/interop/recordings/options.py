"""Options of readers and of the stream of events, with the names of rovioli's flags."""

from pathlib import Path

from maplab_py.errors import FlagError
from maplab_py.interop.device import DeviceOptions
from maplab_py.interop.stamps import time_unit_option
from maplab_py.options import Options, option


class ReadingOptions(Options):
    """Reading of stamps and images."""

    image_bits: int = 0
    """Bits of the values of images that are stored in 16: 8 to 16, as 12; 0 = found in the recording"""
    recording_part: int = option(0, ge=0)
    """Part to read of a recording whose clock starts again, from 1 (see recording_info); 0 = the only one"""
    max_late_share: float = option(0.01, ge=0, le=1)
    """Share of messages with repeated, late or wild stamps up to which they are left out; more is an error"""
    use_arrival_time: bool = False
    """Take the times at which messages of a bag arrived in place of their stamps"""
    skip_missing_images: bool = False
    """Leave out images of a folder's tables whose files are missing"""
    time_unit: str = time_unit_option()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.image_bits and not 8 <= self.image_bits <= 16:
            raise FlagError(f"--image_bits={self.image_bits}: wants 8 to 16, or 0")


class SourceOptions(Options):
    """Opening of a recording."""

    sensor_calibration_file: Path | None = None
    """Calibration: sensors.yaml, kalibr's camchain, or a file of another program that import_calibration
    reads; empty = as the recording has it"""
    imu_calibration_file: Path | None = None
    """File of the IMU, where the calibration has cameras alone, as kalibr's camchain"""
    device: DeviceOptions = DeviceOptions()
    reading: ReadingOptions = ReadingOptions()
    rovio_active_camera_indices: str = ""
    """Cameras to read, separated by commas; empty = all of the calibration"""
    imu_to_camera_time_offset_ns: int | None = None
    """Time of the IMU's clock minus that of the cameras' clock; empty = as the calibration says"""
    imu_topic: str = ""
    """IMU topic of a bag, or two, GYRO,ACCEL, that are joined; empty = as the calibration says"""
    camera_topics: str = ""
    """Image topics of a bag, separated by commas, in the order of the cameras of the calibration; empty = as
    it says"""

    @property
    def active_cameras(self) -> tuple[int, ...]:
        """Indices of the cameras to read; empty = all.

        Raises:
            FlagError: They are not distinct whole numbers.
        """
        try:
            indices = tuple(int(word) for word in _words(self.rovio_active_camera_indices))
        except ValueError:
            indices = (-1,)
        if any(index < 0 for index in indices) or len(set(indices)) != len(indices):
            raise FlagError(
                f"--rovio_active_camera_indices={self.rovio_active_camera_indices}: wants distinct "
                "camera indices separated by commas, as in 0,1"
            )
        return indices

    @property
    def topics_of_imu(self) -> tuple[str, ...]:
        """IMU topic, or those of gyroscope and accelerometer; empty = as the calibration says.

        Raises:
            FlagError: There are more.
        """
        topics = tuple(_words(self.imu_topic))
        if len(topics) > 2:
            raise FlagError(f"--imu_topic={self.imu_topic}: wants one topic, or two, GYRO,ACCEL")
        return topics

    @property
    def topics_of_cameras(self) -> tuple[str, ...]:
        """Image topics in the order of the cameras; empty = as the calibration says."""
        return tuple(_words(self.camera_topics))


class StreamOptions(Options, prefix="vio_"):
    """Part of a recording to read, and the grouping of its images."""

    start_s: float = option(0.0, ge=0, lt=1e9, flag="vio_rosbag_start_s")
    """Skip this much of the recording"""
    end_s: float = option(0.0, ge=0, lt=1e9, flag="vio_rosbag_end_s")
    """Stop this long after the beginning of the recording; 0 = read to its end"""
    nframe_sync_tolerance_ns: int = option(500_000, ge=0, lt=1e9)
    """Largest difference between the times of images of one frame set"""
    imu_gap_s: float = option(0.05, ge=0, lt=1e9)
    """Report intervals between IMU samples that are longer than this"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end_s and self.end_s <= self.start_s:
            raise FlagError(
                f"--vio_rosbag_end_s={self.end_s:g} is not after "
                f"--vio_rosbag_start_s={self.start_s:g}"
            )


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]
