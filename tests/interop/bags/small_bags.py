"""A small map with images, depth maps and clouds, and bags that are read with rosbags."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.interop.ply import PlyCloud, encode_ply
from maplab_py.interop.recordings import bag_files, bag_writing
from maplab_py.interop.resources.depth_maps import RAW_DEPTH_MAPS, encoded_depth
from maplab_py.interop.resources.point_clouds import XYZ, XYZI, XYZRGB
from maplab_py.sensors import CameraRig, Distortion
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import ResourceOwner, VIMap, from_hex
from tests.interop.small_map import CAMERA_ID, IMU_ID, RIG_ID, VERTICES, make_map

FORMATS = list(bag_writing.BagFormat)
OFFSET_NS = 2_500_000


def named(folder: Path, kind: bag_writing.BagFormat, name: str = "walk") -> Path:
    return folder / (name if kind.is_ros_2 else f"{name}.bag")


def map_with_resources() -> tuple[VIMap, list[np.ndarray], list[PlyCloud]]:
    """The first mission has an image per frame, three depth maps and three clouds of its IMU."""
    vi_map = with_time_offset(make_map())
    rng = np.random.default_rng(2)
    images = [rng.integers(0, 256, (480, 640)).astype(np.uint8) for _ in range(VERTICES)]
    p = rng.normal(size=(3, 20, 3)).astype(np.float32).astype(np.float64)
    clouds = [
        PlyCloud(p[0]),
        PlyCloud(p[1], colours=rng.integers(0, 256, (20, 3)).astype(np.uint8)),
        PlyCloud(p[2], intensity=rng.normal(size=20).astype(np.float32).astype(np.float64)),
    ]
    new = NewResources(seed=b"small")
    rows = [new.add_image(image) for image in images]
    vi_map = new.attached(vi_map, rows, np.arange(VERTICES))
    depth_m = np.linspace(0.0, 9.0, 480 * 640).reshape(480, 640)
    rows = [new.add(RAW_DEPTH_MAPS, encoded_depth(depth_m + step)) for step in range(3)]
    vi_map = new.attached(vi_map, rows, np.arange(3))
    kinds = (XYZ, XYZRGB, XYZI)
    rows = [
        new.add(kind, b"".join(encode_ply(cloud)))
        for kind, cloud in zip(kinds, clouds, strict=True)
    ]
    times_ns = vi_map.vertices.timestamp_ns[:3] + 7
    vi_map = new.attached(
        vi_map,
        rows,
        np.zeros(3, dtype=np.int64),
        ResourceOwner.SENSOR,
        sensor_id=from_hex(IMU_ID),
        timestamp_ns=times_ns,
    )
    return vi_map, images, clouds


def with_time_offset(vi_map: VIMap) -> VIMap:
    """The camera's clock differs from the IMU's, and its distortion is one that CameraInfo has."""
    return with_camera(
        vi_map,
        time_offset_ns=OFFSET_NS,
        distortion=Distortion.RADTAN,
        distortion_parameters=np.array([0.1, -0.02, 0.001, 0.003]),
        topic="/left/image_raw",
    )


def with_camera(vi_map: VIMap, **changes: Any) -> VIMap:
    """Return the map with another camera."""
    rig = vi_map.sensors.camera_rig(RIG_ID)
    camera = dataclasses.replace(rig.cameras[0], **changes)
    assert camera.id == CAMERA_ID
    changed = CameraRig(RIG_ID, (camera,), rig.T_B_C)
    sensors = {**vi_map.sensors.sensors, RIG_ID: changed}
    return vi_map.replace(sensors=dataclasses.replace(vi_map.sensors, sensors=sensors))


def messages_of(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return arrivals and messages of each topic, read with rosbags."""
    read: dict[str, list[tuple[int, Any]]] = {}
    with bag_files.opened_bag(path) as reader:
        for connection, time_ns, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            read.setdefault(connection.topic, []).append((time_ns, message))
    return read


def pose_of(transform: Any) -> list[float]:
    """Return a geometry_msgs/Transform as [qx qy qz qw px py pz]."""
    q, p = transform.rotation, transform.translation
    return [q.x, q.y, q.z, q.w, p.x, p.y, p.z]
