"""Images, depth maps and clouds of a bag's topic as resources of a map (maplab's resource importer)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maplab_py.array_types import F32, I64
from maplab_py.errors import MapError, UserError
from maplab_py.interop.bags.options import BagImport, BagImportOptions
from maplab_py.interop.bags.sensor_messages import CAMERA_INFO, CLOUD, COMPRESSED, IMAGE, cloud_of
from maplab_py.interop.calibrations.single_cameras import read_camera_info
from maplab_py.interop.images import CONTAINER_BITS, sampled
from maplab_py.interop.ply import PlyCloud
from maplab_py.interop.recordings import bag_files, protocol
from maplab_py.interop.recordings import images as recorded_images
from maplab_py.interop.resources import matching, point_clouds
from maplab_py.interop.resources.depth_maps import MM_PER_M, RAW_DEPTH_MAPS, encoded_depth
from maplab_py.interop.resources.images import RAW_COLOUR, RAW_GREY, add_image
from maplab_py.progress import SILENT, Progress
from maplab_py.sensors import Camera, projection
from maplab_py.sensors.yaml_entry import Entry
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import VIMap, mission_labels

if TYPE_CHECKING:
    from maplab_py.interop.recordings.bag_files import BagReader

_GRID = 9  # pixels of a row and of a column that are compared


def check_camera_info(message: Any, name: str, camera: Camera, tolerance_px: float) -> float:
    """Compare a CameraInfo with a camera of the map.

    Args:
        name: Bag and topic.
        camera: Camera that the images are said to be of.
        tolerance_px: Largest distance between the pixels of the same ray.

    Returns:
        The largest distance on a grid over the image [px].

    Raises:
        MapError: The message has no calibration, or a model that cameras of maps do not have.
        UserError: It is the calibration of another camera.
    """
    fields = {key.lower(): value for key, value in vars(message).items()}  # ROS 1 has capitals
    keys = ("k", "d", "distortion_model", "width", "height")
    content = {key: np.asarray(fields[key]).tolist() for key in keys}
    (told,) = read_camera_info(Entry(content, name)).cameras
    if (told.width_px, told.height_px) != (camera.width_px, camera.height_px):
        raise UserError(
            f"{name}: its images are {told.width_px} x {told.height_px}, those of the map's camera "
            f"{camera.width_px} x {camera.height_px}: choose the camera by --camera"
        )
    distance_px = largest_distance_px(camera, told)
    if not distance_px <= tolerance_px:
        raise UserError(
            f"{name}: its calibration differs from that of the map's camera by up to "
            f"{distance_px:.3g} px: choose the camera by --camera, take images that are not "
            "rectified, or give a larger --calibration_tolerance_px"
        )
    return distance_px


def largest_distance_px(first: Camera, second: Camera) -> float:
    """Return the largest distance [px] between the pixels of the same ray in two cameras.

    Pixels on a grid of the first camera are compared that have a ray; infinite if the second sees none.
    """
    u = np.linspace(0.0, first.width_px - 1.0, _GRID)
    v = np.linspace(0.0, first.height_px - 1.0, _GRID)
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays, has_ray = projection.back_project(first, uv)
    seen, is_seen = projection.project(second, rays)
    both = has_ray & is_seen
    if not both.any():
        return float("inf")
    return float(np.max(np.linalg.norm(seen[both] - uv[both], axis=1)))


_DEPTH_ENCODINGS = ("16UC1", "32FC1")
_COMPRESSED_DEPTH_HEADER = 12
"""Bytes before the PNG file in messages of compressed_depth_image_transport."""
_FARTHEST_MEDIAN_M = 500.0
"""Depths in metres whose median is larger are in millimetres."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Topic:
    """An open topic."""

    path: Path
    reader: BagReader
    topic: str
    type: str
    stamps_ns: I64  # (N,) as recorded, increasing

    @property
    def name(self) -> str:
        """Bag and topic, for messages."""
        return f"{self.path}: {self.topic}"

    def chosen(self, numbers: I64) -> Iterator[tuple[int, Any]]:
        """Yield the number and the content of some messages (numbers, sorted)."""
        if not len(numbers):
            return
        wanted, last = set(numbers.tolist()), int(numbers[-1])
        for number, (type_, data) in enumerate(_messages(self.path, self.reader, self.topic)):
            if number in wanted:
                yield number, self.reader.deserialize(data, type_)
            if number == last:
                return


def import_bag_resources(
    vi_map: VIMap,
    mission: int,
    path: Path,
    options: BagImportOptions,
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, BagImport]:
    """Attach the images or depth images of a topic to frames, or its clouds to a sensor, of a mission (row).

    A frame gets the message that is nearest in time, if it is the nearest frame of that message, too.
    Images of the encodings 16UC1 (millimetres) and 32FC1 (metres) are depth maps.

    Raises:
        UserError: It is no bag, a topic is missing or of another type, the calibration is of another
            camera, or no message belongs to the mission.
        MapError: The bag or a message is damaged, or stamps run backwards.
    """
    bag_files.check_bag(path, "--rosbag_path")
    with bag_files.opened_bag(path) as reader:
        topic = _opened_topic(path, reader, options.resource_topic)
        if topic.type == CLOUD:
            if options.camera_calibration_topic:
                raise UserError(
                    f"{topic.name} has point clouds: --camera_calibration_topic is for images"
                )
            return _import_clouds(vi_map, mission, topic, options, progress)
        return _import_images(vi_map, mission, topic, options, progress)


def _opened_topic(path: Path, reader: BagReader, asked: str) -> _Topic:
    types = bag_files.topic_types(reader)
    wanted = (IMAGE, COMPRESSED, CLOUD)
    topic = bag_files.topic_in_bag(path, types, asked, "--resource_topic", wanted)
    stamps = [
        bag_files.header_stamp_ns(data, is_ros_2=reader.is2)
        for _, data in _messages(path, reader, topic)
    ]
    stamps_ns = np.array(stamps, dtype=np.int64)
    if not len(stamps_ns):
        raise MapError(f"{path}: {topic} has no messages: give another --resource_topic")
    late = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(late):
        raise MapError(
            f"{path}: {topic}: the stamp {stamps_ns[late[0] + 1]} does not come after that of the "
            "message before it: correct it, or leave the message out with `rosbag filter`"
        )
    return _Topic(path, reader, topic, types[topic], stamps_ns)


def _messages(path: Path, reader: BagReader, topic: str) -> Iterator[tuple[str, bytes]]:
    connections = [c for c in reader.connections if c.topic == topic]
    for connection, _, data in bag_files.all_messages(path, reader, connections):
        yield connection.msgtype, data


def _import_images(
    vi_map: VIMap, mission: int, topic: _Topic, options: BagImportOptions, progress: Progress
) -> tuple[VIMap, BagImport]:
    cameras = matching.mission_rig(vi_map, mission).cameras
    index = _camera_index(cameras, topic, options.camera)
    camera = cameras[index]
    difference_px = _calibration_difference(topic, options, camera)
    _, first = next(topic.chosen(np.array([0])))
    is_depth = _is_depth(first)
    owners, numbers, had_some, without = matching.files_of_frames(
        vi_map,
        mission,
        index,
        (RAW_DEPTH_MAPS,) if is_depth else (RAW_GREY, RAW_COLOUR),
        topic.stamps_ns + camera.time_offset_ns + options.resource_time_offset_ns,
        options.image_tolerance_ms,
    )
    if not len(owners) and not had_some:
        raise UserError(
            f"{topic.name}: no message is within --image_tolerance_ms={options.image_tolerance_ms:g} "
            f"of a frame of camera {index}: check --resource_time_offset_ns and --map_mission"
        )
    new = NewResources(seed=vi_map.missions.id[mission].tobytes())
    bits = CONTAINER_BITS if is_depth else _bits(topic, camera, numbers)
    for done, (number, message) in enumerate(topic.chosen(numbers)):
        progress.step(done, len(numbers), "images")
        name = f"{topic.name} at {topic.stamps_ns[number]}"
        if is_depth:
            new.add(RAW_DEPTH_MAPS, encoded_depth(_depth_m(message, name, camera)))
        else:
            stamp_ns = int(topic.stamps_ns[number])
            data = recorded_images.image_of_message(message, name, camera)
            add_image(new, protocol.CameraImage(0, stamp_ns, stamp_ns, data, bits), link=False)
    attached = new.attached(vi_map, np.arange(len(owners)), owners) if len(owners) else vi_map
    return attached, BagImport(
        mission=mission_labels(vi_map)[mission],
        topic=topic.topic,
        type=topic.type,
        messages=len(topic.stamps_ns),
        resource_types=new.type_names,
        attached=len(owners),
        had_some=had_some,
        frames_without_message=without,
        camera=index,
        calibration_difference_px=difference_px,
    )


def _camera_index(cameras: tuple[Camera, ...], topic: _Topic, asked: int) -> int:
    if asked >= len(cameras):
        raise UserError(f"--camera={asked}: the mission has cameras 0 to {len(cameras) - 1}")
    if asked >= 0:
        return asked
    same = [
        k for k, camera in enumerate(cameras) if camera.topic.strip("/") == topic.topic.strip("/")
    ]
    if len(same) == 1 or len(cameras) == 1:
        return same[0] if same else 0
    raise UserError(
        f"{topic.name}: it is not known which of the {len(cameras)} cameras it is of: give --camera"
    )


def _calibration_difference(
    topic: _Topic, options: BagImportOptions, camera: Camera
) -> float | None:
    """Compare the first CameraInfo with the camera; return the difference [px]."""
    asked, flag = options.camera_calibration_topic, "--camera_calibration_topic"
    if not asked:
        return None
    types = bag_files.topic_types(topic.reader)
    name = bag_files.topic_in_bag(topic.path, types, asked, flag, (CAMERA_INFO,))
    for type_, data in _messages(topic.path, topic.reader, name):
        message = topic.reader.deserialize(data, type_)
        full_name = f"{topic.path}: {name}"
        return check_camera_info(message, full_name, camera, options.calibration_tolerance_px)
    raise MapError(f"{topic.path}: {name} has no messages: give another {flag}")


def _is_depth(message: Any) -> bool:
    if hasattr(message, "encoding"):
        return message.encoding in _DEPTH_ENCODINGS
    return "compressedDepth" in message.format


def _bits(topic: _Topic, camera: Camera, numbers: I64) -> int:
    """Return the bits of the camera's values, sought in some of its messages (numbers, sorted)."""
    images = []
    for _, message in topic.chosen(numbers[sampled(len(numbers))]):
        data = recorded_images.image_of_message(message, topic.name, camera)
        images.append(protocol.CameraImage(0, 0, 0, data))
        if data.bits:
            break
    return recorded_images.camera_bits(images)


def _depth_m(message: Any, name: str, camera: Camera) -> F32:
    """Return depths (H, W) [m] of an image message."""
    if not hasattr(message, "encoding"):
        if not message.format.startswith("16UC1"):
            raise MapError(f"{name}: compressed depth {message.format} is not supported: use 16UC1")
        data = message.data.tobytes()[_COMPRESSED_DEPTH_HEADER:]
        pixels = recorded_images.EncodedImage(name, camera, lambda: data).decode()
        return np.asarray(pixels / np.float32(MM_PER_M), dtype=np.float32)
    if message.encoding == "16UC1":
        pixels = recorded_images.image_of_message(message, name, camera).decode()
        return np.asarray(pixels / np.float32(MM_PER_M), dtype=np.float32)
    if message.encoding != "32FC1":
        raise MapError(f"{name}: encoding '{message.encoding}' in a topic of depth: record 16UC1")
    width, height, step = int(message.width), int(message.height), int(message.step)
    recorded_images.check_size(name, camera, width, height)
    row_bytes = width * np.dtype(np.float32).itemsize
    if step < row_bytes or len(message.data) < step * height:
        raise MapError(f"{name}: the image is truncated: copy the bag again")
    rows = np.asarray(message.data, dtype=np.uint8)[: step * height].reshape(height, step)
    order = ">" if message.is_bigendian else "<"
    depth_m = np.ascontiguousarray(rows[:, :row_bytes]).view(f"{order}f4").astype(np.float32)
    known = depth_m[np.isfinite(depth_m) & (depth_m > 0.0)]
    if len(known) and float(np.median(known)) > _FARTHEST_MEDIAN_M:
        raise MapError(
            f"{name}: half of the depths are beyond {_FARTHEST_MEDIAN_M:g} m: 32FC1 is in metres; "
            "record millimetres as 16UC1"
        )
    return depth_m


def _import_clouds(
    vi_map: VIMap, mission: int, topic: _Topic, options: BagImportOptions, progress: Progress
) -> tuple[VIMap, BagImport]:
    def read(numbers: I64) -> Iterator[Callable[[], PlyCloud]]:
        for number, message in topic.chosen(numbers):
            yield partial(cloud_of, message, f"{topic.name} at {topic.stamps_ns[number]}")

    vi_map, report, outside = point_clouds.attach_clouds(
        vi_map,
        mission,
        options.sensor_id,
        topic.stamps_ns + options.resource_time_offset_ns,
        read,
        topic.name,
        "check --resource_time_offset_ns and --map_mission",
        progress,
    )
    return vi_map, BagImport(
        mission=mission_labels(vi_map)[mission],
        topic=topic.topic,
        type=topic.type,
        messages=report.files_in_folder,
        resource_types=report.resource_types,
        attached=report.attached,
        had_some=report.frames_that_had_some,
        messages_outside_mission=outside,
        notes=report.notes,
    )
