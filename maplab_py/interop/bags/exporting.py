"""A mission of a map as a bag: poses, IMU samples, and the images and clouds among its resources.

A whole map as an mcap recording, for Foxglove and other viewers of robotics.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import UserError
from maplab_py.interop.bags import sensor_messages
from maplab_py.interop.bags.options import BagExportOptions, BagReport, written_topics
from maplab_py.interop.bags.poses import TF_TOPIC
from maplab_py.interop.ply import PlyCloud, parse_ply
from maplab_py.interop.recordings import bag_writing, map_replay
from maplab_py.progress import SILENT, Progress
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import LandmarkQuality, MissionSensor, ResourceOwner, VIMap, queries, to_hex

_IMAGES, _DEPTH, _CLOUDS = (0, 4), (8,), (16, 17, 21)
"""Numbers of the resource types."""
_FRAME = "map"
_CLOSURE_COLOUR = (0.9, 0.4, 0.0, 1.0)


@dataclasses.dataclass(frozen=True, eq=False)
class MessageStream:
    """Messages of a topic in the order of time."""

    topic: str
    count: int
    messages: Iterator[bag_writing.BagMessage]


def export_bag(
    vi_map: VIMap,
    map_folder: Path,
    mission: int,
    path: Path,
    options: BagExportOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> BagReport:
    """Write a mission (row) as a bag.

    Stamps of images are those of their camera's clock, so that a reader with the same calibration gets
    the map's times; all others are of the IMU's clock.

    Args:
        path: File of a ROS 1 bag, or folder of a ROS 2 bag.

    Raises:
        UserError: The bag cannot be written, or the mission has none of the parts.
        MapError: A resource is missing or damaged, or IMU samples run backwards.
    """
    options = options or BagExportOptions()
    contents = options.contents
    kind = bag_writing.format_of_path(path, options.format)
    bag_writing.check_bag_writable(path, kind, overwrite=overwrite)
    export = MissionStreams(vi_map, map_folder, mission, kind, options)
    parts: dict[str, Callable[[], list[MessageStream]]] = {
        "poses": export.poses,
        "path": export.path,
        "odometry": export.odometry,
        "tf": export.tf,
        "imu": export.imu,
        "images": lambda: export.images(_IMAGES, "image_raw"),
        "depth": lambda: export.images(_DEPTH, "depth"),
        "clouds": export.clouds,
    }
    streams = [stream for part in contents for stream in parts[part]() if stream.count]
    topics = [stream.topic for stream in streams]
    twice = next((topic for topic in topics if topics.count(topic) > 1), None)
    if twice is not None:
        raise UserError(
            f"two sensors of the mission have the topic {twice}: give them different ones in sensors.yaml"
        )
    if not streams:
        raise UserError(f"the mission has none of {', '.join(contents)}: choose by --bag_content")
    labels = (queries.mission_labels(vi_map)[mission],)
    report = _write(path, kind, streams, labels, overwrite=overwrite, progress=progress)
    return dataclasses.replace(report, notes=tuple(export.notes))


def export_mcap(
    vi_map: VIMap,
    map_folder: Path,
    path: Path,
    *,
    images: bool = True,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> BagReport:
    """Write paths, poses, landmarks, loop closures and images of all missions as a ROS 2 recording.

    Landmarks, closures and paths have the time of the first vertex, so that they are there at once.

    Args:
        path: Folder to write; it has an .mcap of the same name.

    Raises:
        UserError: The map has no vertices, or the recording cannot be written.
        MapError: An image is missing or damaged.
    """
    if not len(vi_map.vertices):
        raise UserError("the map has no vertices: there is nothing to show")
    kind, labels = bag_writing.BagFormat.MCAP, tuple(queries.mission_labels(vi_map))
    bag_writing.check_bag_writable(path, kind, overwrite=overwrite)
    maker = sensor_messages.MessageMaker(is_ros_2=True)
    begin_ns = vi_map.vertices.timestamp_ns.min(keepdims=True)
    streams = [*_landmarks(vi_map, maker, begin_ns), *_closures(vi_map, maker, begin_ns)]
    for mission, label in enumerate(labels):
        name = "".join(letter if letter.isalnum() else "_" for letter in label)
        parts = MissionStreams(vi_map, map_folder, mission, kind, BagExportOptions())
        streams += parts.path(f"/mission_{name}/path", begin_ns) + parts.poses(
            f"/mission_{name}/pose"
        )
        streams += parts.images(_IMAGES, "image_raw") if images else []
    streams = [stream for stream in streams if stream.count]
    return _write(path, kind, streams, labels, overwrite=overwrite, progress=progress)


class MissionStreams:
    """The parts of a mission as streams of messages."""

    def __init__(
        self,
        vi_map: VIMap,
        map_folder: Path,
        mission: int,
        kind: bag_writing.BagFormat,
        options: BagExportOptions,
    ) -> None:
        self._map, self._mission, self._options = vi_map, mission, options
        self._store = ResourceStore(vi_map, map_folder)
        self._maker = sensor_messages.MessageMaker(is_ros_2=kind.is_ros_2)
        start, stop = vi_map.vertex_start[mission : mission + 2].tolist()
        self._vertices = slice(start, stop)
        self._times_ns: I64 = vi_map.vertices.timestamp_ns[start:stop]
        rig_id = queries.mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
        self._cameras = vi_map.sensors.camera_rig(rig_id).cameras if rig_id else ()
        self._imu_id = queries.mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        self.notes: list[str] = []

    def poses(self, topic: str = "/pose") -> list[MessageStream]:
        """Poses T_G_I."""
        T_G_I = self._map.T_G_I[self._vertices]
        rows = self._maker.poses(self._times_ns, T_G_I, self._options.world_frame)
        return [_stream(topic, sensor_messages.POSE, self._times_ns, rows)]

    def path(self, topic: str = "/path", at_ns: I64 | None = None) -> list[MessageStream]:
        """All poses T_G_I in a message, which arrives at a time; None = the last one."""
        if not len(self._times_ns):
            return []
        T_G_I = self._map.T_G_I[self._vertices]
        row = self._maker.path(self._times_ns, T_G_I, self._options.world_frame)
        arrival_ns = self._times_ns[-1:] if at_ns is None else at_ns
        return [_stream(topic, sensor_messages.PATH, arrival_ns, [row])]

    def odometry(self) -> list[MessageStream]:
        """Poses T_M_I with velocities."""
        table = self._map.vertices
        rows = self._maker.odometry(
            self._times_ns,
            table.T_M_I[self._vertices],
            table.v_M[self._vertices],
            (self._options.odom_frame, self._options.base_frame),
        )
        return [_stream("/odometry", sensor_messages.ODOMETRY, self._times_ns, rows)]

    def tf(self) -> list[MessageStream]:
        """The tree G, M, I and cameras at the time of each vertex."""
        names, count = self._options, len(self._times_ns)
        tree: list[tuple[F64, tuple[str, str]]] = [
            (
                _repeated(self._map.T_G_M[self._mission], count),
                (names.world_frame, names.odom_frame),
            ),
            (self._map.vertices.T_M_I[self._vertices], (names.odom_frame, names.base_frame)),
        ]
        for camera in range(len(self._cameras)):
            T_I_C = self._map.sensors.T_I_S(self._imu_id, self._cameras[camera].id)
            tree.append((_repeated(T_I_C, count), (names.base_frame, f"cam{camera}")))
        rows = self._maker.trees(self._times_ns, tree)
        return [_stream(TF_TOPIC, sensor_messages.TREE, self._times_ns, rows)]

    def imu(self) -> list[MessageStream]:
        """IMU samples, each once."""
        if not self._imu_id:
            return []
        rows = map_replay.mission_sample_rows(self._map, self._mission)
        times_ns = self._map.imu_samples.timestamp_ns[rows]
        samples = self._map.imu_samples.accel_gyro[rows]
        messages = self._maker.imu(times_ns, samples, self._options.base_frame)
        topic = _absolute(self._map.sensors.imu(self._imu_id).topic or "imu0")
        return [_stream(topic, sensor_messages.IMU, times_ns, messages)]

    def images(self, kinds: tuple[int, ...], name: str) -> list[MessageStream]:
        """Images of frames, of some types of resources, and the calibration of their cameras."""
        vi_map, streams = self._map, list[MessageStream]()
        chosen = queries.resources_of(vi_map, kinds, np.array([self._mission]))
        chosen &= vi_map.resources.owner_kind == ResourceOwner.FRAME
        resources = np.flatnonzero(chosen)
        frames = vi_map.resources.owner[resources]
        for index, camera in enumerate(self._cameras):
            of_camera = np.flatnonzero(vi_map.frames.camera_index[frames] == index)
            times_ns = vi_map.frames.timestamp_ns[frames[of_camera]]
            order = np.argsort(times_ns, kind="stable")
            rows, times_ns = resources[of_camera[order]], times_ns[order]
            is_raw = kinds == _IMAGES
            topic = _absolute((is_raw and camera.topic) or f"cam{index}/{name}")
            stamps = times_ns - camera.time_offset_ns
            images = self._images(rows, stamps, f"cam{index}")
            streams.append(_stream(topic, sensor_messages.IMAGE, times_ns, images))
            if is_raw and sensor_messages.has_camera_info(camera):
                info = f"/cam{index}/camera_info"
                infos = self._camera_infos(stamps, index)
                streams.append(_stream(info, sensor_messages.CAMERA_INFO, times_ns, infos))
            elif is_raw and len(rows):
                self.notes.append(f"camera {index} has a model that CameraInfo does not have")
        return streams

    def clouds(self) -> list[MessageStream]:
        """Clouds of sensors."""
        vi_map, table, streams = self._map, self._map.resources, list[MessageStream]()
        chosen = queries.resources_of(vi_map, _CLOUDS, np.array([self._mission]))
        chosen &= table.owner_kind == ResourceOwner.SENSOR
        rows = np.flatnonzero(chosen)
        for number, sensor_id in enumerate(np.unique(table.sensor_id[rows], axis=0)):
            mine = rows[np.all(table.sensor_id[rows] == sensor_id, axis=1)]
            mine = mine[np.argsort(table.timestamp_ns[mine], kind="stable")]
            sensor = vi_map.sensors.sensors.get(to_hex(sensor_id))
            topic = _absolute(getattr(sensor, "topic", "") or f"points{number}")
            times_ns = table.timestamp_ns[mine]
            clouds = self._clouds(mine, times_ns, f"lidar{number}")
            streams.append(_stream(topic, sensor_messages.CLOUD, times_ns, clouds))
        return streams

    def _clouds(self, rows: I64, times_ns: I64, frame: str) -> Iterator[bytes]:
        for row, time_ns in zip(rows.tolist(), times_ns.tolist(), strict=True):
            name = f"resource {to_hex(self._map.resources.id[row])}"
            yield self._maker.cloud(time_ns, frame, parse_ply(self._store.load(row), name))

    def _images(self, rows: I64, stamps_ns: I64, frame: str) -> Iterator[bytes]:
        for row, stamp_ns in zip(rows.tolist(), stamps_ns.tolist(), strict=True):
            yield self._maker.image(stamp_ns, frame, self._store.load(row))

    def _camera_infos(self, stamps_ns: I64, camera: int) -> Iterator[bytes]:
        for stamp_ns in stamps_ns.tolist():
            yield self._maker.camera_info(stamp_ns, f"cam{camera}", self._cameras[camera])


def _landmarks(
    vi_map: VIMap, maker: sensor_messages.MessageMaker, time_ns: I64
) -> list[MessageStream]:
    """Return the good landmarks as a cloud."""
    p_G = vi_map.p_G[vi_map.landmarks.quality == LandmarkQuality.GOOD]
    if not len(p_G):
        return []
    cloud = PlyCloud(p_G.astype(np.float32).astype(np.float64))
    row = maker.cloud(int(time_ns[0]), _FRAME, cloud)
    return [_stream("/landmarks", sensor_messages.CLOUD, time_ns, [row])]


def _closures(
    vi_map: VIMap, maker: sensor_messages.MessageMaker, time_ns: I64
) -> list[MessageStream]:
    """Return the loop closures as lines between their vertices."""
    edges, p_G_I = vi_map.loop_closure_edges, vi_map.T_G_I[:, 4:]
    if not len(edges):
        return []
    ends: F64 = np.stack([p_G_I[edges.from_vertex], p_G_I[edges.to_vertex]], axis=1)
    row = maker.lines(int(time_ns[0]), _FRAME, "loop closures", ends, _CLOSURE_COLOUR)
    return [_stream("/loop_closures", sensor_messages.LINES, time_ns, [row])]


def _stream(topic: str, kind: str, times_ns: I64, rows: Iterable[bytes]) -> MessageStream:
    messages = bag_writing.messages_of_topic(times_ns, topic, kind, rows)
    return MessageStream(topic, len(times_ns), messages)


def _write(
    path: Path,
    kind: bag_writing.BagFormat,
    streams: list[MessageStream],
    missions: tuple[str, ...],
    *,
    overwrite: bool,
    progress: Progress,
) -> BagReport:
    total = sum(stream.count for stream in streams)
    messages = bag_writing.in_order(*(stream.messages for stream in streams))
    watched = bag_writing.watched(messages, total, progress)
    counts = bag_writing.write_bag(path, kind, watched, overwrite=overwrite)
    return BagReport(
        bag=path,
        format=kind.value,
        missions=missions,
        messages=total,
        copied_messages=0,
        topics=written_topics(counts),
    )


def _repeated(T_A_B: F64, count: int) -> F64:
    return np.broadcast_to(T_A_B, (count, 7))


def _absolute(topic: str) -> str:
    return f"/{topic.strip('/')}"
