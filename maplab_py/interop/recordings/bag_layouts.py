"""Kinds of storage files; messages of fixed size as bytes, many at a time: IMU samples, poses, odometry, tf.

Sources: ROS 1, wiki "Connection Header" and genmsg (little endian, unaligned); ROS 2, OMG DDS-XTypes 1.3,
section 7.4.1 (plain CDR, numbers aligned to their size behind an encapsulation of four bytes).
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError

SQLITE = b"SQLite format 3\x00"
_HEADS = ((b"#ROSBAG V2.", "ros1"), (SQLITE, "sqlite3"), (b"\x89MCAP0\r\n", "mcap"))
_ENDINGS = ((".mcap", "mcap"), (".db3", "sqlite3"), (".bag", "ros1"))
_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_S_TO_NS = 1_000_000_000
_UNKNOWN = -1.0
"""First entry of a covariance whose quantity is not measured (sensor_msgs/Imu)."""


def full_type(name: str) -> str:
    """Return the name of a message type as package/msg/Name; ROS 1 writes package/Name."""
    package, _, rest = name.partition("/")
    return name if not rest or "/" in rest else f"{package}/msg/{rest}"


def storage_kind(path: Path) -> str:
    """Return ros1, sqlite3 or mcap: the kind of a bag's file by its first bytes, else by its name."""
    with path.open("rb") as stream:
        head = stream.read(len(SQLITE))
    by_content = (kind for start, kind in _HEADS if head.startswith(start))
    by_name = (kind for ending, kind in _ENDINGS if ending in path.name.lower())
    return next(by_content, "") or next(by_name, "")


class MessageLayout:
    """Places of the fields of a message, when its texts are known."""

    def __init__(self, *, is_ros_2: bool) -> None:
        self._is_ros_2 = is_ros_2
        self._template = bytearray(_CDR_LITTLE_ENDIAN if is_ros_2 else b"")
        self._origin = len(self._template)
        self._fields: dict[str, tuple[str, tuple[int, ...], int]] = {}

    def header(self, name: str, frame: str) -> None:
        """Append a std_msgs/Header; its stamp is the columns <name>_s and <name>_ns."""
        if not self._is_ros_2:
            self.constant("<u4", 0)  # sequence number
        self.values(f"{name}_s", "<i4" if self._is_ros_2 else "<u4")
        self.values(f"{name}_ns", "<u4")
        self.text(frame)

    def text(self, text: str) -> None:
        """Append a text."""
        data = text.encode() + (b"\x00" if self._is_ros_2 else b"")
        self.constant("<u4", len(data))
        self._template += data

    def constant(self, kind: str, value: ArrayLike) -> None:
        """Append numbers that all messages share."""
        numbers = np.atleast_1d(np.asarray(value, dtype=kind))
        self._align(numbers.dtype.itemsize)
        self._template += numbers.tobytes()

    def values(self, name: str, kind: str, *shape: int) -> None:
        """Append a column: numbers that each message has."""
        dtype = np.dtype(kind)
        self._align(dtype.itemsize)
        self._fields[name] = (kind, shape, len(self._template))
        self._template += bytes(dtype.itemsize * int(np.prod(shape, dtype=np.int64)))

    def filled(self, count: int, **columns: ArrayLike) -> list[bytes]:
        """Return messages (count,) with the values of all columns (count, ...)."""
        size = len(self._template)
        table: NDArray[Any] = np.empty(
            count,
            dtype=np.dtype(
                {
                    "names": list(self._fields),
                    "formats": [(kind, shape) for kind, shape, _ in self._fields.values()],
                    "offsets": [offset for _, _, offset in self._fields.values()],
                    "itemsize": size,
                }
            ),
        )
        table.view(np.uint8).reshape(count, size)[:] = np.frombuffer(self._template, np.uint8)
        for name in self._fields:
            table[name] = columns[name]
        data = table.tobytes()
        return [data[start : start + size] for start in range(0, count * size, size)]

    def _align(self, size: int) -> None:
        if self._is_ros_2:
            self._template += bytes(-(len(self._template) - self._origin) % size)


def stamp_columns(name: str, times_ns: I64, *, is_ros_2: bool) -> dict[str, I64]:
    """Return the columns of the stamps (N,) of a header.

    Raises:
        UserError: A time is before 1970, or after what the messages can hold.
    """
    seconds = times_ns // _S_TO_NS
    last = np.iinfo(np.int32).max if is_ros_2 else np.iinfo(np.uint32).max
    wrong = np.flatnonzero((seconds < 0) | (seconds > last))
    if len(wrong):
        raise UserError(
            f"the time {times_ns[wrong[0]]} ns cannot be written into a bag: stamps go from 0 to "
            f"{last} s; move the stamps of the map"
        )
    return {f"{name}_s": seconds, f"{name}_ns": times_ns - seconds * _S_TO_NS}


def imu_messages(times_ns: I64, accel_gyro: F64, frame: str, *, is_ros_2: bool) -> list[bytes]:
    """Return sensor_msgs/Imu without orientation.

    Args:
        times_ns: Stamps (N,).
        accel_gyro: Samples (N, 6) [ax ay az gx gy gz], m/s^2 and rad/s.
        is_ros_2: CDR, else ROS 1.
    """
    layout = MessageLayout(is_ros_2=is_ros_2)
    layout.header("stamp", frame)
    layout.constant("<f8", [0.0, 0.0, 0.0, 1.0])
    layout.constant("<f8", [_UNKNOWN, *[0.0] * 8])
    layout.values("gyro", "<f8", 3)
    layout.constant("<f8", np.zeros(9))  # covariance: unknown
    layout.values("accel", "<f8", 3)
    layout.constant("<f8", np.zeros(9))
    return layout.filled(
        len(times_ns),
        accel=accel_gyro[:, :3],
        gyro=accel_gyro[:, 3:],
        **stamp_columns("stamp", times_ns, is_ros_2=is_ros_2),
    )


def pose_messages(times_ns: I64, T_A_B: F64, frame: str, *, is_ros_2: bool) -> list[bytes]:
    """Return geometry_msgs/PoseStamped of poses T_A_B (N, 7); the frame is A."""
    layout = MessageLayout(is_ros_2=is_ros_2)
    layout.header("stamp", frame)
    layout.values("p", "<f8", 3)
    layout.values("q", "<f8", 4)
    stamps = stamp_columns("stamp", times_ns, is_ros_2=is_ros_2)
    return layout.filled(len(times_ns), p=T_A_B[:, 4:], q=T_A_B[:, :4], **stamps)


def transform_messages(
    times_ns: I64, T_A_B: F64, frames: tuple[str, str], *, is_ros_2: bool
) -> list[bytes]:
    """Return geometry_msgs/TransformStamped of poses T_A_B (N, 7); the frames are A and B."""
    layout = MessageLayout(is_ros_2=is_ros_2)
    return _transforms(layout, times_ns, [(T_A_B, frames)], is_ros_2=is_ros_2)


def tf_messages(
    times_ns: I64, transforms: list[tuple[F64, tuple[str, str]]], *, is_ros_2: bool
) -> list[bytes]:
    """Return tf2_msgs/TFMessage, each with the transforms of a time.

    Args:
        times_ns: Stamps (N,).
        transforms: Poses T_A_B (N, 7) with the names of the frames A and B.
        is_ros_2: CDR, else ROS 1.
    """
    layout = MessageLayout(is_ros_2=is_ros_2)
    layout.constant("<u4", len(transforms))
    return _transforms(layout, times_ns, transforms, is_ros_2=is_ros_2)


def odometry_messages(
    times_ns: I64,
    T_A_B: F64,
    v_A: F64,
    frames: tuple[str, str],
    *,
    is_ros_2: bool,
    w_B: ArrayLike = 0.0,
    pose_covariance: ArrayLike = 0.0,
    twist_covariance: ArrayLike = 0.0,
) -> list[bytes]:
    """Return nav_msgs/Odometry; its twist is in B.

    Args:
        times_ns: Stamps (N,).
        T_A_B: Poses (N, 7).
        v_A: Velocities (N, 3) of B, in A [m/s].
        frames: Names of A and B.
        is_ros_2: CDR, else ROS 1.
        w_B: Angular velocities (N, 3) of B, in B [rad/s].
        pose_covariance: (N, 36) of position and turn about the axes of A; 0 = unknown.
        twist_covariance: (N, 36) of velocity and angular velocity in B; 0 = unknown.
    """
    from maplab_py.geometry import so3

    layout = MessageLayout(is_ros_2=is_ros_2)
    layout.header("stamp", frames[0])
    layout.text(frames[1])
    layout.values("p", "<f8", 3)
    layout.values("q", "<f8", 4)
    layout.values("pose_covariance", "<f8", 36)
    layout.values("v", "<f8", 3)
    layout.values("w", "<f8", 3)
    layout.values("twist_covariance", "<f8", 36)
    return layout.filled(
        len(times_ns),
        p=T_A_B[:, 4:],
        q=T_A_B[:, :4],
        pose_covariance=pose_covariance,
        v=so3.rotate(so3.inverse(T_A_B[:, :4]), v_A),
        w=w_B,
        twist_covariance=twist_covariance,
        **stamp_columns("stamp", times_ns, is_ros_2=is_ros_2),
    )


def _transforms(
    layout: MessageLayout,
    times_ns: I64,
    transforms: list[tuple[F64, tuple[str, str]]],
    *,
    is_ros_2: bool,
) -> list[bytes]:
    """Append TransformStamped to a layout; return its messages."""
    columns: dict[str, ArrayLike] = {}
    for row, (T_A_B, (frame_A, frame_B)) in enumerate(transforms):
        layout.header(f"{row}_stamp", frame_A)
        layout.text(frame_B)
        layout.values(f"{row}_p", "<f8", 3)
        layout.values(f"{row}_q", "<f8", 4)
        columns |= {f"{row}_p": T_A_B[:, 4:], f"{row}_q": T_A_B[:, :4]}
        columns |= stamp_columns(f"{row}_stamp", times_ns, is_ros_2=is_ros_2)
    return layout.filled(len(times_ns), **columns)
