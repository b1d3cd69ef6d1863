"""Samples, poses, images, calibrations and point clouds as serialised messages, and clouds back."""

from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import so3
from maplab_py.interop.ply import EmptyCloud, PlyCloud, cloud_of_table
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.sensors import Camera, Distortion, Projection

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
IMU, POSE = "sensor_msgs/msg/Imu", "geometry_msgs/msg/PoseStamped"
TRANSFORM, TREE = "geometry_msgs/msg/TransformStamped", "tf2_msgs/msg/TFMessage"
ODOMETRY, PATH = "nav_msgs/msg/Odometry", "nav_msgs/msg/Path"
LINES = "visualization_msgs/msg/Marker"
_LINE_LIST, _LINE_WIDTH_M = 5, 0.02
_NAME = 2
"""Kind of a field of the library rosbags: a message."""
_S_TO_NS = 1_000_000_000
_NONE, _UNKNOWN = np.zeros(3), np.zeros(36)
_NOT_MEASURED = np.append(-1.0, np.zeros(8))
"""Covariance of a quantity that is not measured (sensor_msgs/Imu)."""
_ENCODINGS = {("uint8", 2): "mono8", ("uint8", 3): "bgr8", ("uint16", 2): "16UC1"}
_DISTORTIONS = {
    Distortion.NONE: "plumb_bob",
    Distortion.RADTAN: "plumb_bob",
    Distortion.EQUIDISTANT: "equidistant",
    Distortion.FOV: "fov",
}
_FLOAT32, _FLOAT64 = 7, 8
_POINT_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    _FLOAT32: "f4",
    _FLOAT64: "f8",
}
"""numpy's names of the data types of sensor_msgs/PointField."""
_MAX_POINTS = 50_000_000
_FARTHEST_MEDIAN_M = 1000.0
"""Distances whose median is larger are in millimetres."""


class MessageMaker:
    """Serialises messages of ROS 1 or ROS 2."""

    def __init__(self, *, is_ros_2: bool) -> None:
        """Load the definitions of the standard messages.

        Raises:
            UserError: The library is missing.
        """
        self._is_ros_2 = is_ros_2
        self._store: Any = message_types(is_ros_2=is_ros_2)
        self._last_s = (1 << (31 if is_ros_2 else 32)) - 1
        self._nested: dict[str, list[tuple[int, str, bool]]] = {}  # place, type; several of them

    def imu(self, times_ns: I64, accel_gyro: F64, frame: str) -> list[bytes]:
        """Return sensor_msgs/Imu without orientation.

        Args:
            times_ns: Stamps (N,).
            accel_gyro: Samples (N, 6) [ax ay az gx gy gz], m/s^2 and rad/s.
            frame: Name of the frame.
        """
        turn, unknown = (0.0, 0.0, 0.0, 1.0), np.zeros(9)
        return [
            self._bytes(IMU, head, turn, _NOT_MEASURED, sample[3:], unknown, sample[:3], unknown)
            for head, sample in zip(
                self._headers(times_ns, frame), accel_gyro.tolist(), strict=True
            )
        ]

    def poses(self, times_ns: I64, T_A_B: F64, frame: str) -> list[bytes]:
        """Return geometry_msgs/PoseStamped of poses T_A_B (N, 7); the frame is A."""
        return [self._bytes(POSE, *stamped) for stamped in self._stamped(times_ns, T_A_B, frame)]

    def path(self, times_ns: I64, T_A_B: F64, frame: str) -> bytes:
        """Return a nav_msgs/Path of poses T_A_B (N, 7), N > 0; the frame is A, the stamp the last time."""
        poses = self._stamped(times_ns, T_A_B, frame)
        return self._bytes(PATH, poses[-1][0], poses)

    def transforms(self, times_ns: I64, T_A_B: F64, frames: tuple[str, str]) -> list[bytes]:
        """Return geometry_msgs/TransformStamped of poses T_A_B (N, 7); the frames are A and B."""
        return [
            self._bytes(TRANSFORM, head, frames[1], pose)
            for head, pose in self._stamped(times_ns, T_A_B, frames[0])
        ]

    def trees(self, times_ns: I64, transforms: list[tuple[F64, tuple[str, str]]]) -> list[bytes]:
        """Return tf2_msgs/TFMessage, each with the transforms of a time.

        Args:
            times_ns: Stamps (N,).
            transforms: Poses T_A_B (N, 7) with the names of the frames A and B.
        """
        columns = [
            [(head, B, pose) for head, pose in self._stamped(times_ns, T_A_B, A)]
            for T_A_B, (A, B) in transforms
        ]
        return [self._bytes(TREE, list(row)) for row in zip(*columns, strict=True)]

    def odometry(
        self,
        times_ns: I64,
        T_A_B: F64,
        v_A: F64,
        frames: tuple[str, str],
        *,
        w_B: F64 = _NONE,
        pose_covariance: F64 = _UNKNOWN,
        twist_covariance: F64 = _UNKNOWN,
    ) -> list[bytes]:
        """Return nav_msgs/Odometry; its twist is in B.

        Args:
            times_ns: Stamps (N,).
            T_A_B: Poses (N, 7).
            v_A: Velocities (N, 3) of B, in A [m/s].
            frames: Names of A and B.
            w_B: Angular velocity (3,) of B, in B [rad/s].
            pose_covariance: (36,) of position and turn about the axes of A; 0 = unknown.
            twist_covariance: (36,) of velocity and angular velocity in B; 0 = unknown.
        """
        v_B = so3.rotate(so3.inverse(T_A_B[:, :4]), v_A).tolist()
        return [
            self._bytes(
                ODOMETRY,
                head,
                frames[1],
                (pose, pose_covariance),
                ((velocity, w_B.tolist()), twist_covariance),
            )
            for (head, pose), velocity in zip(
                self._stamped(times_ns, T_A_B, frames[0]), v_B, strict=True
            )
        ]

    def image(self, stamp_ns: int, frame: str, pixels: NDArray[Any]) -> bytes:
        """Return an Image of pixels (H, W) 8 or 16 bits, or (H, W, 3) BGR."""
        height, width = pixels.shape[:2]
        encoding = _ENCODINGS[pixels.dtype.name, pixels.ndim]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        header = self._header(stamp_ns, frame)
        step = len(data) // height
        return self._bytes(IMAGE, header, height, width, encoding, 0, step, data)

    def lines(
        self,
        stamp_ns: int,
        frame: str,
        name: str,
        ends: F64,
        colour: tuple[float, float, float, float],
    ) -> bytes:
        """Return a Marker of ROS 2: lines between points (L, 2, 3), coloured (red, green, blue, alpha)."""
        none, nowhere = np.zeros(0, dtype=np.uint8), (_NONE.tolist(), (0.0, 0.0, 0.0, 1.0))
        shape = (name, 0, _LINE_LIST, 0, nowhere, (_LINE_WIDTH_M, 0.0, 0.0), colour, (0, 0), False)
        texture: tuple[Any, ...] = ("", (((0, 0), ""), "", none), [], "", "", ("", none), False)
        points = ends.reshape(-1, 3).tolist()
        return self._bytes(LINES, self._header(stamp_ns, frame), *shape, points, [], *texture)

    def camera_info(self, stamp_ns: int, frame: str, camera: Camera) -> bytes:
        """Return the CameraInfo of a pinhole camera; see `has_camera_info`."""
        fu, fv, cu, cv = camera.intrinsics.tolist()
        K = np.array([fu, 0.0, cu, 0.0, fv, cv, 0.0, 0.0, 1.0])
        P = np.array([fu, 0.0, cu, 0.0, 0.0, fv, cv, 0.0, 0.0, 0.0, 1.0, 0.0])
        D = np.array(camera.distortion_parameters, dtype=np.float64)
        model = _DISTORTIONS[camera.distortion]
        if model == "plumb_bob":
            D = np.concatenate([D, np.zeros(5 - len(D))])
        size, region = (camera.height_px, camera.width_px), (0, 0, 0, 0, False)
        matrices = (D, K, np.eye(3).reshape(-1), P)
        header = self._header(stamp_ns, frame)
        return self._bytes(CAMERA_INFO, header, *size, model, *matrices, 0, 0, region)

    def cloud(self, stamp_ns: int, frame: str, cloud: PlyCloud) -> bytes:
        """Return a PointCloud2 with the colours and intensities that there are.

        Coordinates are floats of 32 bits, of 64 where these would round.
        """
        kind = "f4" if np.array_equal(cloud.p.astype(np.float32), cloud.p) else "f8"
        columns: list[tuple[str, str, NDArray[Any]]] = [
            (name, kind, cloud.p[:, axis]) for axis, name in enumerate("xyz")
        ]
        if cloud.intensity is not None:
            columns.append(("intensity", "f4", cloud.intensity))
        if cloud.colours is not None:  # a word of 32 bits, by convention called a float
            red, green, blue = cloud.colours.T.astype(np.uint32)
            word = ((red << 16) | (green << 8) | blue).view(np.float32)
            columns.append(("rgb", "f4", word))
        table = np.zeros(len(cloud.p), dtype=[(name, f"<{kind}") for name, kind, _ in columns])
        for name, _, values in columns:
            table[name] = values
        numbers = {"f4": _FLOAT32, "f8": _FLOAT64}
        fields = [
            (name, table.dtype.fields[name][1], numbers[kind], 1)  # type: ignore[index]
            for name, kind, _ in columns
        ]
        layout = (1, len(table), fields, False, table.itemsize, table.nbytes)
        data = table.view(np.uint8).reshape(-1)
        return self._bytes(CLOUD, self._header(stamp_ns, frame), *layout, data, True)

    def _stamped(self, times_ns: I64, T_A_B: F64, frame: str) -> list[tuple[Any, Any]]:
        """Return headers and poses."""
        poses = [(row[4:], row[:4]) for row in T_A_B.tolist()]
        return list(zip(self._headers(times_ns, frame), poses, strict=True))

    def _headers(self, times_ns: I64, frame: str) -> list[Any]:
        return [self._header(time_ns, frame) for time_ns in times_ns.tolist()]

    def _header(self, stamp_ns: int, frame: str) -> Any:
        """Return a std_msgs/Header.

        Raises:
            UserError: The time is before 1970, or after what the messages can hold.
        """
        time = divmod(stamp_ns, _S_TO_NS)
        if not 0 <= time[0] <= self._last_s:
            raise UserError(
                f"the time {stamp_ns} ns cannot be written into a bag: stamps go from 0 to {self._last_s} s; "
                "move the stamps of the map"
            )
        return (time, frame) if self._is_ros_2 else (0, time, frame)

    def _bytes(self, kind: str, *fields: Any) -> bytes:
        write = self._store.serialize_cdr if self._is_ros_2 else self._store.serialize_ros1
        return bytes(write(self._message(kind, fields), kind))

    def _message(self, kind: str, fields: Any) -> Any:
        """Return a message of its fields, in which a sequence stands for a message, or a list for several."""
        if kind not in self._nested:
            self._nested[kind] = [
                (place, content if node == _NAME else content[0][1], node != _NAME)
                for place, (_, (node, content)) in enumerate(self._store.fielddefs[kind][1])
                if node == _NAME or content[0][0] == _NAME
            ]
        parts = list(fields)
        for place, name, are_several in self._nested[kind]:
            part = parts[place]
            parts[place] = (
                [self._message(name, entry) for entry in part]
                if are_several
                else self._message(name, part)
            )
        return self._store.types[kind](*parts)


def has_camera_info(camera: Camera) -> bool:
    """Tell whether a CameraInfo can hold the model of a camera."""
    return camera.projection is Projection.PINHOLE


def cloud_of(message: Any, name: str) -> PlyCloud:
    """Return the points of a PointCloud2 whose coordinates are finite.

    Raises:
        MapError: It has no x, y, z, no points, or fewer bytes than it says; names the message.
    """
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= fields.keys():
        raise MapError(f"{name}: the cloud has no x, y, z: record clouds in Cartesian coordinates")
    if not int(message.width) * int(message.height):
        raise EmptyCloud(f"{name}: the cloud is empty: leave its time out, or record it again")
    count, row_bytes = int(message.width) * int(message.height), int(message.row_step)
    step, data = int(message.point_step), np.asarray(message.data, dtype=np.uint8)
    if count > _MAX_POINTS or len(data) < row_bytes * int(message.height):
        raise MapError(f"{name}: the cloud is truncated or damaged: copy the bag again")
    order = ">" if message.is_bigendian else "<"
    known = {key: field for key, field in fields.items() if field.datatype in _POINT_TYPES}
    try:
        dtype = np.dtype(
            {
                "names": list(known),
                "formats": [order + _POINT_TYPES[field.datatype] for field in known.values()],
                "offsets": [int(field.offset) for field in known.values()],
                "itemsize": step,
            }
        )
        rows = data[: row_bytes * int(message.height)].reshape(int(message.height), row_bytes)
        packed = np.ascontiguousarray(rows[:, : int(message.width) * step])
        table = packed.reshape(-1).view(dtype)
        cloud = cloud_of_table(table)
    except (ValueError, KeyError) as error:
        raise MapError(
            f"{name}: the cloud is damaged ({error}): leave its time out, or record it again"
        ) from error
    valid: NDArray[np.bool_] = np.all(np.isfinite(cloud.p), axis=1)
    if not valid.any():
        raise EmptyCloud(f"{name}: the cloud is empty: leave its time out, or record it again")
    if float(np.median(np.linalg.norm(cloud.p[valid], axis=1))) > _FARTHEST_MEDIAN_M:
        raise MapError(
            f"{name}: half of the points are beyond {_FARTHEST_MEDIAN_M:g} m: coordinates are in "
            "metres; record them so"
        )
    return cloud.where(valid)
