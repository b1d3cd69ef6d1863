"""A whole map as an mcap recording, for Foxglove and other viewers of robotics."""

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.interop.bags.exporting import IMAGES, MessageStream, MissionStreams
from maplab_py.interop.bags.options import BagExportOptions, BagReport, written_topics
from maplab_py.interop.bags.sensor_messages import CLOUD, LINES, PATH, MessageMaker
from maplab_py.interop.ply import PlyCloud
from maplab_py.interop.recordings import bag_layouts, bag_writing
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import LandmarkQuality, VIMap, mission_labels

_FRAME = "map"
_POSE = "geometry_msgs/msg/PoseStamped"
_CLOSURE_COLOUR = (0.9, 0.4, 0.0, 1.0)


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
        map_folder: Folder of the map, where its images are.
        path: Folder to write; it has an .mcap of the same name.
        images: Write the images among the resources, too.
        overwrite: Replace a recording that exists.

    Raises:
        UserError: The map has no vertices, or the recording cannot be written.
        MapError: An image is missing or damaged.
    """
    if not len(vi_map.vertices):
        raise UserError("the map has no vertices: there is nothing to show")
    bag_writing.check_bag_writable(path, bag_writing.BagFormat.MCAP, overwrite=overwrite)
    maker = MessageMaker(is_ros_2=True)
    begin_ns = int(vi_map.vertices.timestamp_ns.min())
    streams = [*_landmarks(vi_map, maker, begin_ns), *_closures(vi_map, maker, begin_ns)]
    for mission, label in enumerate(mission_labels(vi_map)):
        streams += _mission(vi_map, maker, mission, label, begin_ns)
        if images:
            options = BagExportOptions()
            parts = MissionStreams(vi_map, map_folder, mission, bag_writing.BagFormat.MCAP, options)
            streams += [s for s in parts.images(IMAGES, "image_raw") if s.count]
    total = sum(stream.count for stream in streams)
    messages = bag_writing.watched(
        bag_writing.in_order(*(stream.messages for stream in streams)), total, progress
    )
    counts = bag_writing.write_bag(path, bag_writing.BagFormat.MCAP, messages, overwrite=overwrite)
    return BagReport(
        bag=path,
        format=bag_writing.BagFormat.MCAP.value,
        missions=tuple(mission_labels(vi_map)),
        messages=total,
        copied_messages=0,
        topics=written_topics(counts),
    )


def _landmarks(vi_map: VIMap, maker: MessageMaker, time_ns: int) -> list[MessageStream]:
    """Return the good landmarks as a cloud."""
    p_G = vi_map.p_G[vi_map.landmarks.quality == LandmarkQuality.GOOD]
    if not len(p_G):
        return []
    row = maker.cloud(time_ns, _FRAME, PlyCloud(p_G.astype(np.float32).astype(np.float64)))
    return [_single("/landmarks", CLOUD, time_ns, row)]


def _closures(vi_map: VIMap, maker: MessageMaker, time_ns: int) -> list[MessageStream]:
    """Return the loop closures as lines between their vertices."""
    edges, p_G_I = vi_map.loop_closure_edges, vi_map.T_G_I[:, 4:]
    if not len(edges):
        return []
    ends: F64 = np.stack([p_G_I[edges.from_vertex], p_G_I[edges.to_vertex]], axis=1)
    row = maker.lines(time_ns, _FRAME, "loop closures", ends, _CLOSURE_COLOUR)
    return [_single("/loop_closures", LINES, time_ns, row)]


def _mission(
    vi_map: VIMap, maker: MessageMaker, mission: int, label: str, begin_ns: int
) -> list[MessageStream]:
    """Return the path of a mission, and its poses at their times."""
    rows = slice(*vi_map.vertex_start[mission : mission + 2].tolist())
    times_ns, T_G_I = vi_map.vertices.timestamp_ns[rows], vi_map.T_G_I[rows]
    if not len(times_ns):
        return []
    name = "".join(letter if letter.isalnum() else "_" for letter in label)
    poses = bag_layouts.pose_messages(times_ns, T_G_I, _FRAME, is_ros_2=True)
    topic = f"/mission_{name}/pose"
    path = maker.path(times_ns, T_G_I, _FRAME)
    return [
        _single(f"/mission_{name}/path", PATH, begin_ns, path),
        MessageStream(
            topic, len(poses), bag_writing.messages_of_topic(times_ns, topic, _POSE, poses)
        ),
    ]


def _single(topic: str, kind: str, time_ns: int, row: bytes) -> MessageStream:
    times_ns = np.array([time_ns], dtype=np.int64)
    return MessageStream(topic, 1, bag_writing.messages_of_topic(times_ns, topic, kind, [row]))
