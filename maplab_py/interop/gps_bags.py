"""Positions of satellite receivers in bags of ROS 1 and ROS 2: sensor_msgs/NavSatFix.

Source: sensor_msgs/NavSatFix and NavSatStatus: degrees and ellipsoidal altitude on WGS 84; a status below
zero is a receiver without a fix.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.errors import UserError
from maplab_py.interop.gps import NO_FIX, GpsTrack, gps_track, read_gps
from maplab_py.interop.recordings import bag_files

NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
_FIX_FROM = 0
"""Status of a fix without augmentation; -1 is none."""


def read_fixes(path: Path, date: str = "", topic: str = "", time_unit: str = "") -> GpsTrack:
    """Read fixes from a bag, or from CSV or NMEA; arguments and errors as in the readers of these.

    Raises:
        UserError: A topic is given for a file that is no bag.
    """
    if bag_files.is_bag(path):
        return read_gps_bag(path, topic)
    if topic:
        raise UserError(f"{path} is no bag: leave out --gps_topic={topic}")
    return read_gps(path, date, time_unit)


def read_gps_bag(path: Path, topic: str = "") -> GpsTrack:
    """Read the fixes of a topic; empty = the only one with fixes.

    Raises:
        UserError: It is no bag, or the topic does not exist or has something else.
        MapError: The bag or a message is damaged, there are no fixes, or stamps go back.
    """
    bag_files.check_bag(path, "--gps_file")
    rows: list[tuple[float, float, float]] = []
    stamps: list[int] = []
    reasons: list[str] = []
    with bag_files.opened_bag(path) as reader:
        name = _chosen(path, bag_files.topic_types(reader), topic)
        connections = [c for c in reader.connections if c.topic == name]
        for connection, _, data in bag_files.all_messages(path, reader, connections):
            message: Any = reader.deserialize(data, connection.msgtype)
            status = int(message.status.status)
            reasons.append(f"{NO_FIX} (status {status})" if status < _FIX_FROM else "")
            rows.append((message.latitude, message.longitude, message.altitude))
            stamps.append(bag_files.header_stamp_ns(data, is_ros_2=reader.is2))
    fixes = np.array(rows, dtype=np.float64).reshape(-1, 3)
    return gps_track(
        np.array(stamps, dtype=np.int64), fixes, f"{path}: {name}", np.array(reasons, dtype=np.str_)
    )


def _chosen(path: Path, types: dict[str, str], topic: str) -> str:
    fixes = sorted(name for name, kind in types.items() if kind == NAV_SAT_FIX)
    wanted = [name for name in fixes if topic in ("", name)]
    if len(wanted) == 1:
        return wanted[0]
    if topic:
        what = f"is of type {types[topic]}" if topic in types else "is not in it"
        raise UserError(
            f"{path}: the topic --gps_topic={topic} {what}; topics: {bag_files.listed_topics(types)}"
        )
    if not fixes:
        raise UserError(
            f"{path}: no topic has sensor_msgs/NavSatFix; topics: {bag_files.listed_topics(types)}"
        )
    raise UserError(
        f"{path}: several topics have fixes: choose with --gps_topic: {', '.join(fixes)}"
    )
