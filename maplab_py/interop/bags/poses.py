"""Poses of a map as messages, and a bag copied with them (maplab's pose_to_bag)."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maplab_py.array_types import F64, I64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.interop.bags import sensor_messages
from maplab_py.interop.bags.options import BagReport, PoseToBagOptions, written_topics
from maplab_py.interop.recordings import bag_files, bag_writing
from maplab_py.interop.vertex_states import poses_at
from maplab_py.progress import SILENT, Progress
from maplab_py.vimap import VIMap, mission_labels, mission_time_spans_ns

TF_TOPIC = "/tf"
_S_TO_NS = 1e9


@dataclasses.dataclass(frozen=True, eq=False)
class MissionPoses:
    """Poses of a mission, and the names of its frames."""

    times_ns: I64  # (N,)
    T_M_I: F64  # (N, 7)
    T_G_M: F64  # (7,)
    frames: tuple[str, str, str]  # G, M, I
    suffix: str  # of topics


def add_poses_to_bag(
    vi_map: VIMap,
    source: Path,
    target: Path,
    options: PoseToBagOptions | None = None,
    *,
    missions: I64 | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> BagReport:
    """Copy a bag and add the poses of missions, each at its time.

    Messages of the bag are copied byte by byte, and the format stays. With several missions the names of
    frames and topics end in _0, _1, ... by the time of their beginning.

    Raises:
        UserError: The source is no bag, the target exists, or there is nothing to add.
        MapError: The source is damaged.
    """
    options = options or PoseToBagOptions()
    bag_files.check_bag(source, "--rosbag_plugin_input_bag")
    if target.exists() and target.resolve() == source.resolve():
        raise UserError(f"--rosbag_plugin_output_bag={target} is the input: name another bag")
    kind = bag_writing.format_of_bag(source)
    bag_writing.format_of_path(target, kind.value)
    bag_writing.check_bag_writable(target, kind, overwrite=overwrite)
    poses = [*_mission_poses(vi_map, missions, options)]
    if not poses:
        raise UserError("the missions have no vertices: there are no poses to add")
    dropped = (TF_TOPIC,) if options.drop_tf else ()
    with bag_files.opened_bag(source) as reader:
        present = {(c.topic, c.msgtype): bag_writing.channel_of(c) for c in reader.connections}
        _check_types(source, present, poses, options, kind)
        added = [_added(entry, options, kind, present) for entry in poses]
        total = reader.message_count + sum(len(entry.times_ns) for entry in poses)
        copied = sum(c.msgcount for c in reader.connections if c.topic not in dropped)
        counts = bag_writing.write_bag(
            target,
            kind,
            bag_writing.watched(
                bag_writing.in_order(
                    bag_writing.messages_of_bag(source, reader, without=dropped),
                    *(stream for streams in added for stream in streams),
                ),
                total,
                progress,
            ),
            overwrite=overwrite,
        )
    labels = mission_labels(vi_map)
    rows = range(len(labels)) if missions is None else missions.tolist()
    return BagReport(
        bag=target,
        format=kind.value,
        missions=tuple(labels[row] for row in rows),
        topics=written_topics(counts),
        copied_messages=copied,
        messages=sum(counts.values()),
    )


def pose_times(stamps_ns: I64, period_ns: int) -> I64:
    """Return the stamps (N,), and times every period behind each of them up to the next one."""
    extra = np.maximum((np.diff(stamps_ns) - 1) // period_ns, 0)
    start = np.repeat(np.cumsum(extra) - extra, extra)
    step = np.arange(int(extra.sum())) - start + 1
    between = np.repeat(stamps_ns[:-1], extra) + step * period_ns
    return np.sort(np.concatenate([stamps_ns, between]))


def _mission_poses(
    vi_map: VIMap, missions: I64 | None, options: PoseToBagOptions
) -> Iterator[MissionPoses]:
    """Yield the poses of missions (rows) that have vertices, by the time of their beginning."""
    rows = np.arange(len(vi_map.missions)) if missions is None else missions
    rows = rows[np.diff(vi_map.vertex_start)[rows] > 0]
    rows = rows[np.argsort(mission_time_spans_ns(vi_map)[rows, 0], kind="stable")]
    period_ns = round(_S_TO_NS / options.interpolate_to_frequency_hz)
    for number, row in enumerate(rows.tolist()):
        suffix = f"_{number}" if len(rows) > 1 else ""
        start, stop = vi_map.vertex_start[row : row + 2].tolist()
        times_ns = pose_times(vi_map.vertices.timestamp_ns[start:stop], period_ns)
        yield MissionPoses(
            times_ns,
            poses_at(vi_map, row, times_ns),
            vi_map.T_G_M[row],
            (options.world_frame, options.odom_frame + suffix, options.base_frame + suffix),
            suffix,
        )


def _added(
    poses: MissionPoses,
    options: PoseToBagOptions,
    kind: bag_writing.BagFormat,
    present: dict[tuple[str, str], bag_writing.Channel],
) -> list[Iterator[bag_writing.BagMessage]]:
    """Return the streams of messages of a mission; topics that the bag has go on in their channel."""
    world, odom, base = poses.frames
    maker = sensor_messages.MessageMaker(is_ros_2=kind.is_ros_2)
    T_G_M, T_M_I = np.broadcast_to(poses.T_G_M, poses.T_M_I.shape), poses.T_M_I
    streams: list[tuple[str, str, list[bytes]]] = []
    if options.add_transform_stamped:
        for name, T, frames in (
            ("T_G_I", se3.compose(T_G_M, T_M_I), (world, base)),
            ("T_M_I", T_M_I, (odom, base)),
            ("T_G_M", T_G_M, (world, odom)),
        ):
            rows = maker.transforms(poses.times_ns, T, frames)
            streams.append((f"/{name}{poses.suffix}", sensor_messages.TRANSFORM, rows))
    if options.add_tf:
        tree = [(T_G_M, (world, odom)), (T_M_I, (odom, base))]
        rows = maker.trees(poses.times_ns, tree)
        streams.append((TF_TOPIC, sensor_messages.TREE, rows))
    return [
        bag_writing.messages_of_topic(poses.times_ns, topic, type_, rows, present)
        for topic, type_, rows in streams
    ]


def _check_types(
    source: Path,
    present: dict[tuple[str, str], bag_writing.Channel],
    poses: list[MissionPoses],
    options: PoseToBagOptions,
    kind: bag_writing.BagFormat,
) -> None:
    """Refuse a bag whose topics of the same names have other types.

    ROS 1 knows the transforms of /tf under an older name of their type, too.
    """
    added = {TF_TOPIC: {sensor_messages.TREE}} if options.add_tf and not options.drop_tf else {}
    if kind is bag_writing.BagFormat.ROS1 and added:
        added[TF_TOPIC].add("tf/msg/tfMessage")
    if options.add_transform_stamped:
        names = ("T_G_I", "T_M_I", "T_G_M")
        added |= {
            f"/{name}{entry.suffix}": {sensor_messages.TRANSFORM}
            for name in names
            for entry in poses
        }
    for topic, type_ in present:
        if topic in added and type_ not in added[topic]:
            remedy = "--rosbag_plugin_pose_to_bag_drop_tf or " if topic == TF_TOPIC else ""
            raise MapError(
                f"{source}: {topic} has messages of type {type_}, not {sorted(added[topic])[0]}: "
                f"give {remedy}another bag"
            )
