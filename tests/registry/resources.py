"""A map with a resource of every type that commands show."""

from pathlib import Path

import cv2
import numpy as np

from maplab_py.interop.bags.sensor_messages import IMAGE, MessageMaker
from maplab_py.interop.ply import PlyCloud, write_ply
from maplab_py.interop.recordings.bag_writing import BagFormat, BagMessage, Channel, write_bag
from maplab_py.interop.resources.matching import camera_frames, mission_rig
from maplab_py.storage.native import save_map
from maplab_py.storage.resources.store import relative_path
from maplab_py.storage.resources.types import RESOURCE_TYPES
from maplab_py.vimap import ResourceOwner, Resources, VIMap, random_ids

_TYPES = {kind.name: kind.number for kind in RESOURCE_TYPES}
_SHOWN = (
    "raw_images",
    "undistorted_images",
    "raw_color_images",
    "undistorted_color_images",
    "raw_depth_maps",
    "optimized_depth_maps",
    "disparity_maps",
    "point_cloud",
    "color_point_cloud",
    "point_cloud_w_intensity",
)


def save_with_resources(vi_map: VIMap, folder: Path) -> None:
    """Save a map with resources and their files."""
    table = Resources.filled(
        len(_SHOWN),
        id=random_ids(len(_SHOWN), np.random.default_rng(0)),
        type=[_TYPES[name] for name in _SHOWN],
        owner_kind=[ResourceOwner.FRAME] * len(_SHOWN),
        owner=np.arange(len(_SHOWN)),
    )
    owner_kind = np.array(table.owner_kind)
    owner_kind[-1] = ResourceOwner.MISSION
    owner = np.array(table.owner)
    owner[-1] = 0
    vi_map = vi_map.replace(resources=table.replace(owner_kind=owner_kind, owner=owner))
    save_map(vi_map, folder)
    for row, name in enumerate(_SHOWN):
        path = folder / "resources" / relative_path(vi_map, row)
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, name)


def _write(path: Path, name: str) -> None:
    if "cloud" in name:
        points = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, -1.0, 3.0]])
        write_ply(PlyCloud(points, np.full((3, 3), 7, dtype=np.uint8)), path)
    elif "depth" in name or "disparity" in name:
        depth = np.zeros((480, 640), dtype=np.uint16)
        depth[240, 320] = 2500
        cv2.imwrite(str(path), depth)
    else:
        shape = (24, 32, 3) if "color" in name else (24, 32)
        cv2.imwrite(str(path), np.full(shape, 80, dtype=np.uint8))


def write_stamped_files(vi_map: VIMap, folder: Path) -> None:
    """Write images, depth maps and clouds of the first vertices, named by their time stamps."""
    camera = mission_rig(vi_map, 0).cameras[0]
    images = folder / "images_of_v1_01" / "mav0" / "cam0"
    for place in (images / "data", folder / "depth_of_v1_01", folder / "clouds_of_v1_01"):
        place.mkdir(parents=True)
    stamps = vi_map.frames.timestamp_ns[camera_frames(vi_map, 0, 0)[:3]].tolist()
    size = camera.height_px, camera.width_px
    for stamp in stamps:
        cv2.imwrite(str(images / "data" / f"{stamp}.png"), np.full(size, 80, dtype=np.uint8))
        depth = np.full(size, 2500, dtype=np.uint16)
        cv2.imwrite(str(folder / "depth_of_v1_01" / f"{stamp}.png"), depth)
        write_ply(PlyCloud(np.eye(3)), folder / "clouds_of_v1_01" / f"{stamp}.ply")
    _write_bag(stamps, size, folder / "images_of_v1_01.bag")
    (images / "data.csv").write_text("".join(f"{stamp},{stamp}.png\n" for stamp in stamps))


def _write_bag(stamps: list[int], size: tuple[int, int], path: Path) -> None:
    """Write images as a ROS 1 bag."""
    maker, channel = MessageMaker(is_ros_2=False), Channel("/cam0/image_raw", IMAGE)
    pixels = np.full(size, 80, dtype=np.uint8)
    messages = (BagMessage(t, channel, maker.image(t, "cam0", pixels)) for t in stamps)
    write_bag(path, BagFormat.ROS1, messages)
