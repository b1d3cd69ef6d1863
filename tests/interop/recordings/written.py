"""A small recording, written as an EuRoC folder and as bags."""

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.interop.imu_csv import ImuRecording, write_imu_csv
from maplab_py.interop.recordings import protocol
from maplab_py.sensors.sensors_yaml import write_sensors

START_NS = 1403715273262142976
WIDTH, HEIGHT = 64, 48
INTRINSICS = [50.0, 51.0, 32.0, 24.0]


@dataclasses.dataclass(frozen=True, eq=False)
class Content:
    """What was recorded."""

    imu_ns: I64
    accel_gyro: F64
    stamps_ns: tuple[I64, ...]  # by camera
    images: tuple[list[np.ndarray], ...]


def make_content(
    cameras: int = 2, frames: int = 8, *, dtype: Any = np.uint8, channels: int = 1
) -> Content:
    """Images at 20 Hz and IMU samples at 200 Hz that begin 20 ms before and end 20 ms after."""
    rng = np.random.default_rng(4)
    frame_ns = START_NS + np.arange(frames) * 50_000_000
    imu_ns = np.arange(START_NS - 20_000_000, frame_ns[-1] + 20_000_001, 5_000_000)
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    top = np.iinfo(dtype).max
    return Content(
        imu_ns,
        rng.normal(size=(len(imu_ns), 6)),
        tuple(frame_ns + 1000 * camera for camera in range(cameras)),
        tuple(
            [rng.integers(0, top, shape).astype(dtype) for _ in range(frames)]
            for _ in range(cameras)
        ),
    )


def sensor_yaml(camera: int) -> str:
    """The calibration of a camera, 0.1 m apart from the one before it."""
    return (
        "sensor_type: camera\ncomment: small\nT_BS:\n  cols: 4\n  rows: 4\n  data: "
        f"[0.0, -1.0, 0.0, {0.1 * camera}, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.02, 0.0, 0.0, 0.0, 1.0]\n"
        f"rate_hz: 20\nresolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\n"
        f"intrinsics: {INTRINSICS}\ndistortion_model: radial-tangential\n"
        f"distortion_coefficients: [0.1, 0.01, 0.001, {0.001 * camera}]\n"
    )


IMU_YAML = """sensor_type: imu
comment: small
T_BS:
  cols: 4
  rows: 4
  data: [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
rate_hz: 200
gyroscope_noise_density: 1.6968e-04
gyroscope_random_walk: 1.9393e-05
accelerometer_noise_density: 2.0000e-3
accelerometer_random_walk: 3.0000e-3
"""


def write_folder(content: Content, folder: Path, *, suffix: str = ".png") -> Path:
    """Write `folder/mav0`; return the folder."""
    imu = folder / "mav0" / "imu0"
    imu.mkdir(parents=True)
    write_imu_csv(ImuRecording(content.imu_ns, content.accel_gyro), imu / "data.csv")
    (imu / "sensor.yaml").write_text(IMU_YAML)
    for camera, (stamps_ns, images) in enumerate(
        zip(content.stamps_ns, content.images, strict=True)
    ):
        home = folder / "mav0" / f"cam{camera}"
        (home / "data").mkdir(parents=True)
        (home / "sensor.yaml").write_text(sensor_yaml(camera))
        lines = ["#timestamp [ns],filename"]
        for stamp, image in zip(stamps_ns.tolist(), images, strict=True):
            cv2.imwrite(str(home / "data" / f"{stamp}{suffix}"), image)
            lines.append(f"{stamp},{stamp}{suffix}")
        (home / "data.csv").write_text("\n".join(lines) + "\n")
    return folder


def write_calibration(device: protocol.RecordedSensors, path: Path) -> Path:
    """Write sensors.yaml with the topics /imu0 and /cam0/image_raw, /cam1/image_raw, ..."""
    imu = dataclasses.replace(device.imu, topic="/imu0")
    cameras = tuple(
        dataclasses.replace(camera, topic=f"/cam{row}/image_raw")
        for row, camera in enumerate(device.cameras)
    )
    rig = dataclasses.replace(device.rig, cameras=cameras)
    sensors = dataclasses.replace(device.sensors, sensors={imu.id: imu, rig.id: rig})
    path.write_text(write_sensors(sensors))
    return path


def write_bag(
    content: Content,
    path: Path,
    *,
    version: int = 1,
    encoding: str = "mono8",
    delay_ns: tuple[int, int] = (0, 0),
    storage: str = "",
) -> Path:
    """Write a bag; messages arrive in the order of time plus the delay of IMU and cameras.

    Args:
        content: What was recorded.
        path: File of a ROS 1 bag, or folder of a ROS 2 bag.
        version: 1 or 2.
        encoding: Of the images; png or jpeg for compressed ones.
        delay_ns: Between the stamps and the arrival of IMU samples and of images.
        storage: sqlite3 or mcap, of ROS 2.
    """
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    messages = []
    for stamp, values in zip(content.imu_ns.tolist(), content.accel_gyro, strict=True):
        messages.append((stamp + delay_ns[0], "/imu0", imu_message(store, stamp, values, version)))
    for camera, (stamps_ns, images) in enumerate(
        zip(content.stamps_ns, content.images, strict=True)
    ):
        for stamp, image in zip(stamps_ns.tolist(), images, strict=True):
            message = image_message(store, stamp, image, encoding, version)
            messages.append((stamp + delay_ns[1], f"/cam{camera}/image_raw", message))
    messages.sort(key=lambda entry: (entry[0], entry[1]))
    write_messages(path, store, messages, version=version, storage=storage)
    return path


def write_messages(
    path: Path,
    store: Any,
    messages: list[tuple[int, str, Any]],
    *,
    version: int = 1,
    storage: str = "",
) -> None:
    """Write messages (arrival, topic, message) in their order."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    writer: Any
    if version == 1:
        writer = Writer1(path)
    else:
        kind = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=kind)
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr
    connections: dict[str, Any] = {}
    with writer:
        for arrival, topic, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(connections[topic], arrival, serialize(message, kind))


def header(store: Any, stamp: int, version: int) -> Any:
    """A header with a stamp."""
    time = store.types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    return kind(0, time, "sensor") if version == 1 else kind(time, "sensor")


def imu_message(store: Any, stamp: int, values: F64, version: int) -> Any:
    """An IMU message."""
    vector, none = store.types["geometry_msgs/msg/Vector3"], np.zeros(9)
    quaternion = store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    accel, gyro = vector(*values[:3].tolist()), vector(*values[3:].tolist())
    kind = store.types["sensor_msgs/msg/Imu"]
    return kind(header(store, stamp, version), quaternion, none, gyro, none, accel, none)


def image_message(
    store: Any, stamp: int, image: np.ndarray, encoding: str, version: int, *, padding: int = 4
) -> Any:
    """An image message (pixels in BGR), rows padded; compressed for the encodings png and jpeg."""
    head = header(store, stamp, version)
    if encoding in ("png", "jpeg"):
        done, data = cv2.imencode(".png" if encoding == "png" else ".jpg", image)
        assert done
        return store.types["sensor_msgs/msg/CompressedImage"](head, encoding, data.reshape(-1))
    pixels = image[:, :, ::-1] if encoding == "rgb8" else image
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(image.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    kind = store.types["sensor_msgs/msg/Image"]
    height, width = image.shape[:2]
    return kind(head, height, width, encoding, 0, rows.shape[1], rows.reshape(-1))


def samples(events: list[protocol.Event]) -> tuple[I64, F64]:
    """All IMU samples of a stream."""
    batches = [event for event in events if isinstance(event, protocol.ImuBatch)]
    return (
        np.concatenate([batch.times_ns for batch in batches]),
        np.concatenate([batch.accel_gyro for batch in batches]),
    )


def frame_sets(events: list[protocol.Event]) -> list[protocol.FrameSet]:
    """All frame sets of a stream."""
    return [event for event in events if isinstance(event, protocol.FrameSet)]


def assert_content(events: list[protocol.Event], content: Content) -> None:
    """Compare a stream with what was recorded: every sample, stamp and pixel, and the order."""
    times_ns, accel_gyro = samples(events)
    np.testing.assert_array_equal(times_ns, content.imu_ns)
    np.testing.assert_array_equal(accel_gyro, content.accel_gyro)
    sets = frame_sets(events)
    assert [s.time_ns for s in sets] == content.stamps_ns[0].tolist()
    for row, frame_set in enumerate(sets):
        for camera, image in enumerate(frame_set.images):
            assert_image(image, camera, content, row)
    assert_in_order(events)


def assert_image(image: protocol.CameraImage, camera: int, content: Content, row: int) -> None:
    assert (image.camera, image.stamp_ns) == (camera, content.stamps_ns[camera][row])
    pixels = image.decode()
    assert pixels.dtype == content.images[camera][row].dtype
    np.testing.assert_array_equal(pixels, content.images[camera][row])


def assert_in_order(events: list[protocol.Event]) -> None:
    """IMU samples increase, and those up to the time of a frame set come before it, no others."""
    last_sample = last_set = -1
    for event in events:
        if isinstance(event, protocol.ImuBatch):
            assert event.time_ns > max(last_sample, last_set)
            assert np.all(np.diff(event.times_ns) > 0)
            last_sample = int(event.times_ns[-1])
        else:
            assert event.time_ns >= last_sample
            assert event.time_ns > last_set
            last_set = event.time_ns
