"""Finding the reader and the calibration of a recording."""

from pathlib import Path

from maplab_py.errors import UserError
from maplab_py.interop.calibration_import import import_calibration, read_calibration
from maplab_py.interop.calibrations.euroc import HOW_TO_CALIBRATE
from maplab_py.interop.device import RecordedSensors, at_middle_rows, with_cameras, with_time_offset
from maplab_py.interop.recordings.bag_files import is_bag
from maplab_py.interop.recordings.bags import BagRecording
from maplab_py.interop.recordings.folders import FolderRecording, image_root
from maplab_py.interop.recordings.images import check_size
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import Recording

_MOST_LISTED = 3
_ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".7z", ".rar")


def open_recording(path: Path, options: SourceOptions | None = None) -> Recording:
    """Open an EuRoC or TUM-VI folder, or a ROS bag.

    Raises:
        UserError: It is none of them, has no calibration, or a topic is unknown.
        MapError: A file of it is missing or damaged.
    """
    options = options or SourceOptions()
    root = image_root(path)
    if root is not None:
        if options.imu_topic or options.camera_topics:
            raise UserError(
                f"{path} is a folder: --imu_topic and --camera_topics apply to bags only"
            )
        if options.reading.use_arrival_time:
            raise UserError(f"{path} is a folder: --use_arrival_time applies to bags only")
        active = options.active_cameras
        device = _chosen(_calibration(options) or import_calibration(root), options)
        return _checked(FolderRecording(root, device, active, options.reading), options)
    if not path.exists():
        raise UserError(f"{path} does not exist: give a folder with mav0, or a ROS bag")
    if not is_bag(path):
        raise UserError(
            f"{path} is no recording: wants a folder with mav0/cam0, a ROS 1 bag (.bag) or a ROS 2 "
            f"bag (a folder, or a file .db3 or .mcap){_hint(path)}"
        )
    return _checked(
        BagRecording(
            path,
            given_device(options, f"{path}: a bag"),
            imu_topics=options.topics_of_imu,
            camera_topics=options.topics_of_cameras,
            reading=options.reading,
        ),
        options,
    )


def _hint(path: Path) -> str:
    """Return a clause on what the user may have meant."""
    if path.suffixes[-2:] == [".bag", ".active"]:
        return f"; it is a bag that was not closed: run `rosbag reindex {path}` and name it .bag"
    if path.suffix.lower() in _ARCHIVES:
        return "; it is an archive: unpack it first"
    whole = next((p for p in path.absolute().parents if image_root(p) is not None), None)
    if whole is not None:
        return f"; it is a part of {whole}"
    if not path.is_dir():
        return ""
    below = [p for p in sorted(path.iterdir()) if image_root(p) is not None or is_bag(p)]
    listed = ", ".join(map(str, below[:_MOST_LISTED])) + (
        ", ..." if len(below) > _MOST_LISTED else ""
    )
    return f"; it holds {listed}" if below else ""


def _checked(recording: BagRecording | FolderRecording, options: SourceOptions) -> Recording:
    """Return the recording if its sensors have time in common and images the size that was calibrated.

    Raises:
        MapError: They have not.
        UserError: There is no such part.
    """
    recording.check_common_time(has_shift=options.imu_to_camera_time_offset_ns is not None)
    for row, size_px in recording.first_sizes_px.items():
        check_size(f"{recording.name}: camera {row}", recording.device.cameras[row], *size_px)
    return recording


def given_device(options: SourceOptions, source: str) -> RecordedSensors:
    """Return the sensors of the calibration that the options name.

    Raises:
        UserError: They name none; `source` has none.
        MapError: A file of it is missing or damaged.
    """
    given = _calibration(options)
    if given is None:
        raise UserError(f"{source} has no calibration: {HOW_TO_CALIBRATE}")
    return _chosen(given, options)


def _chosen(device: RecordedSensors, options: SourceOptions) -> RecordedSensors:
    """Return the device with the cameras and the time offset of middle rows that the options choose."""
    chosen = at_middle_rows(with_cameras(device, options.active_cameras))
    if options.imu_to_camera_time_offset_ns is None:
        return chosen
    return with_time_offset(chosen, options.imu_to_camera_time_offset_ns)


def _calibration(options: SourceOptions) -> RecordedSensors | None:
    """Return the calibration that the options name, None if they name none."""
    if options.sensor_calibration_file is not None:
        return read_calibration(
            options.sensor_calibration_file, options.imu_calibration_file, options.device
        )
    if options.imu_calibration_file is not None:
        raise UserError(
            f"--imu_calibration_file={options.imu_calibration_file} needs the camera chain that it "
            "belongs to: give --sensor_calibration_file=FILE"
        )
    options.device.check_unused("give it as --sensor_calibration_file=FILE")
    return None
