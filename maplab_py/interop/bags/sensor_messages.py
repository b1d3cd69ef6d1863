"""Images, calibrations and point clouds as serialised messages, and back."""

from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, NDArray
from maplab_py.errors import MapError
from maplab_py.interop.ply import EmptyCloud, PlyCloud, cloud_of_table
from maplab_py.interop.recordings.bag_files import message_types
from maplab_py.sensors import Camera, Distortion, Projection

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
PATH = "nav_msgs/msg/Path"
LINES = "visualization_msgs/msg/Marker"
_LINE_LIST, _LINE_WIDTH_M = 5, 0.02
_S_TO_NS = 1_000_000_000
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
        self._is_ros_2, self._store = is_ros_2, message_types(is_ros_2=is_ros_2)

    def image(self, stamp_ns: int, frame: str, pixels: NDArray[Any]) -> bytes:
        """Return an Image of pixels (H, W) 8 or 16 bits, or (H, W, 3) BGR."""
        height, width = pixels.shape[:2]
        encoding = _ENCODINGS[pixels.dtype.name, pixels.ndim]
        data = np.ascontiguousarray(pixels).view(np.uint8).reshape(-1)
        header = self._header(stamp_ns, frame)
        step = len(data) // height
        return self._bytes(IMAGE, header, height, width, encoding, 0, step, data)

    def path(self, times_ns: I64, T_A_B: F64, frame: str) -> bytes:
        """Return a nav_msgs/Path of poses T_A_B (N, 7), N > 0; the frame is A, the stamp the last time."""
        types = self._store.types
        point, quaternion, pose, stamped = (
            types[f"geometry_msgs/msg/{name}"]
            for name in ("Point", "Quaternion", "Pose", "PoseStamped")
        )
        poses = [
            stamped(self._header(time_ns, frame), pose(point(*T[4:]), quaternion(*T[:4])))
            for time_ns, T in zip(times_ns.tolist(), T_A_B.tolist(), strict=True)
        ]
        return self._bytes(PATH, self._header(int(times_ns[-1]), frame), poses)

    def lines(
        self,
        stamp_ns: int,
        frame: str,
        name: str,
        ends: F64,
        colour: tuple[float, float, float, float],
    ) -> bytes:
        """Return a Marker of ROS 2: lines between points (L, 2, 3), coloured (red, green, blue, alpha)."""
        types = self._store.types
        point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
        quaternion, pose = types["geometry_msgs/msg/Quaternion"], types["geometry_msgs/msg/Pose"]
        time, colour_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/ColorRGBA"]
        none, nothing = np.zeros(0, dtype=np.uint8), types["std_msgs/msg/Header"](time(0, 0), "")
        return self._bytes(
            LINES,
            self._header(stamp_ns, frame),
            name,
            0,
            _LINE_LIST,
            0,
            pose(point(0.0, 0.0, 0.0), quaternion(0.0, 0.0, 0.0, 1.0)),
            vector(_LINE_WIDTH_M, 0.0, 0.0),
            colour_type(*colour),
            types["builtin_interfaces/msg/Duration"](0, 0),
            False,
            [point(*p) for p in ends.reshape(-1, 3).tolist()],
            [],
            "",
            types[COMPRESSED](nothing, "", none),
            [],
            "",
            "",
            types["visualization_msgs/msg/MeshFile"]("", none),
            False,
        )

    def camera_info(self, stamp_ns: int, frame: str, camera: Camera) -> bytes:
        """Return the CameraInfo of a pinhole camera; see `has_camera_info`."""
        fu, fv, cu, cv = camera.intrinsics.tolist()
        K = np.array([fu, 0.0, cu, 0.0, fv, cv, 0.0, 0.0, 1.0])
        P = np.array([fu, 0.0, cu, 0.0, 0.0, fv, cv, 0.0, 0.0, 0.0, 1.0, 0.0])
        D = np.array(camera.distortion_parameters, dtype=np.float64)
        if _DISTORTIONS[camera.distortion] == "plumb_bob":
            D = np.concatenate([D, np.zeros(5 - len(D))])
        region = self._store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
        return self._bytes(
            CAMERA_INFO,
            self._header(stamp_ns, frame),
            camera.height_px,
            camera.width_px,
            _DISTORTIONS[camera.distortion],
            D,
            K,
            np.eye(3).reshape(-1),
            P,
            0,
            0,
            region,
        )

    def cloud(self, stamp_ns: int, frame: str, cloud: PlyCloud) -> bytes:
        """Return a PointCloud2 with the colours and intensities that there are.

        Coordinates are floats of 32 bits, of 64 where these would round.
        """
        kind = "f4" if np.array_equal(cloud.p.astype(np.float32), cloud.p) else "f8"
        fields = [(name, kind) for name in ("x", "y", "z")]
        columns: list[NDArray[Any]] = [cloud.p[:, axis] for axis in range(3)]
        if cloud.intensity is not None:
            fields.append(("intensity", "f4"))
            columns.append(cloud.intensity)
        if cloud.colours is not None:
            fields.append(("rgb", "f4"))  # a word of 32 bits, by convention called a float
            red, green, blue = cloud.colours.T.astype(np.uint32)
            columns.append(((red << 16) | (green << 8) | blue).view(np.float32))
        table = np.zeros(len(cloud.p), dtype=[(name, f"<{kind}") for name, kind in fields])
        for (name, _), values in zip(fields, columns, strict=True):
            table[name] = values
        point_field = self._store.types["sensor_msgs/msg/PointField"]
        numbers = {"f4": _FLOAT32, "f8": _FLOAT64}
        described = [
            point_field(name, table.dtype.fields[name][1], numbers[kind], 1)  # type: ignore[index]
            for name, kind in fields
        ]
        return self._bytes(
            CLOUD,
            self._header(stamp_ns, frame),
            1,
            len(table),
            described,
            False,
            table.itemsize,
            table.nbytes,
            table.view(np.uint8).reshape(-1),
            True,
        )

    def _header(self, stamp_ns: int, frame: str) -> Any:
        types = self._store.types
        time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _S_TO_NS))
        header = types["std_msgs/msg/Header"]
        return header(time, frame) if self._is_ros_2 else header(0, time, frame)

    def _bytes(self, kind: str, *fields: Any) -> bytes:
        message = self._store.types[kind](*fields)
        write = self._store.serialize_cdr if self._is_ros_2 else self._store.serialize_ros1
        return bytes(write(message, kind))


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
