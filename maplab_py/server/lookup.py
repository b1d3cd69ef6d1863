"""Questions to a published map: where a sensor's point was, and the dense map around a position."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import se3
from maplab_py.geometry.interpolation import interpolate_poses
from maplab_py.server.reports import LookupReport
from maplab_py.storage.resource_types import resource_type
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import mission_sensor_id
from maplab_py.vimap.resource_queries import resources_of


def map_lookup(vi_map: VIMap, robot: str, timestamp_ns: int, sensor: str, p_S: F64) -> LookupReport:
    """Return where a point in the frame of a robot's sensor was in G.

    Args:
        vi_map: The map; its missions are named after their robots.
        robot: Name of the robot.
        timestamp_ns: Time [ns].
        sensor: Id of the sensor; empty = the IMU.
        p_S: Point (3,) in the frame of the sensor [m].

    Raises:
        UserError: The robot has no mission at that time, or the sensor is not mounted.
    """
    rows = [row for row, name in enumerate(vi_map.missions.name) if name == robot]
    if not rows:
        known = ", ".join(sorted(set(vi_map.missions.name))) or "none"
        raise UserError(f"--robot_name={robot}: the map has no mission of it (robots: {known})")
    for mission in rows:
        of_mission = slice(*vi_map.vertex_start[mission : mission + 2].tolist())
        times_ns = vi_map.vertices.timestamp_ns[of_mission]
        if len(times_ns) and times_ns[0] <= timestamp_ns <= times_ns[-1]:
            break
    else:
        raise UserError(
            f"--timestamp_ns={timestamp_ns}: robot {robot} is not in the map then, but "
            + ", ".join(_times(vi_map, mission) for mission in rows)
        )
    T_G_I, _ = interpolate_poses(
        times_ns, vi_map.T_G_I[of_mission], np.array([timestamp_ns], dtype=np.int64)
    )
    T_G_S = T_G_I[0]
    if sensor:
        imu = mission_sensor_id(vi_map, mission, MissionSensor.IMU)
        try:
            T_G_S = se3.compose(T_G_S, vi_map.sensors.T_I_S(imu, sensor))
        except (MapError, KeyError) as error:
            raise UserError(f"--sensor={sensor}: {error}") from error
    x, y, z = se3.transform(T_G_S, p_S).tolist()
    is_known = bool(vi_map.baseframes.is_known[vi_map.missions.baseframe[mission]])
    a, b, c = T_G_S[4:].tolist()
    return LookupReport(
        robot, to_hex(vi_map.missions.id[mission]), is_known, timestamp_ns, (x, y, z), (a, b, c)
    )


def dense_points_in_range(
    vi_map: VIMap, map_folder: Path, type_number: int, center_G: F64, radius_m: float
) -> tuple[F64, int]:
    """Return the points (N, 3) in G of dense resources in a sphere, and how many clouds they are from.

    Args:
        vi_map: The map.
        map_folder: Where it was loaded from.
        type_number: Type of the resources: clouds or depth maps.
        center_G: Centre (3,) of the sphere [m].
        radius_m: Its radius.

    Raises:
        UserError: The map has no resource of the type, or only in missions that are not anchored.
        MapError: A file is missing or damaged.
    """
    from maplab_py.viewer.options import PointCloudOptions
    from maplab_py.viewer.resource_clouds import load_clouds

    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    name = resource_type(type_number).name
    anchored = resources_of(vi_map, (type_number,), np.flatnonzero(known))
    if not anchored.any() and resources_of(vi_map, (type_number,)).any():
        raise UserError(
            f"the resources of type '{name}' are all of missions that are not anchored yet, so it is not "
            "known where they are in the map: serve_status says which robots have such missions"
        )
    clouds = load_clouds(
        vi_map, map_folder, name, PointCloudOptions(), missions=np.flatnonzero(known)
    )
    inside = [
        cloud.p_G[np.linalg.norm(cloud.p_G - center_G, axis=1) <= radius_m] for cloud in clouds
    ]
    inside = [points for points in inside if len(points)]
    return np.concatenate(inside) if inside else np.zeros((0, 3)), len(inside)


def _times(vi_map: VIMap, mission: int) -> str:
    """Return the first and the last time of a mission (row) in words."""
    times_ns = vi_map.vertices.timestamp_ns[slice(*vi_map.vertex_start[mission : mission + 2])]
    return f"from {times_ns[0]} to {times_ns[-1]} ns" if len(times_ns) else "has no vertices"
