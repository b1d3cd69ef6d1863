"""Requests of the service: look-ups from the published map, changes through the loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from maplab_py.array_types import F64
from maplab_py.errors import UserError
from maplab_py.report import Message
from maplab_py.server.lookup import dense_points_in_range, map_lookup
from maplab_py.server.reports import DeletedMissions
from maplab_py.server.service import Answer
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.queries import find_mission

if TYPE_CHECKING:
    from maplab_py.server.server import MapServer


def answers(server: MapServer) -> tuple[dict[str, Answer], dict[str, Answer]]:
    """Return the answers to GET and to POST by name."""
    reads = {
        "serve_status": lambda _: server.status(),
        "map_lookup": lambda given: _lookup(server, given),
        "get_dense_map_in_range": lambda given: _dense(server, given),
    }
    writes = {
        "serve_stop": lambda _: _stop(server),
        "delete_mission": lambda given: server.call(lambda: _delete(server, given["mission"])),
        "delete_all_robot_missions": lambda given: server.call(
            lambda: _delete_robot(server, given["robot_name"])
        ),
    }
    return reads, writes


def point(text: str, flag: str) -> F64:
    """Read "x y z" [m] as a point (3,); raises UserError."""
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 3 or not np.isfinite(values).all():
        raise UserError(f'--{flag}={text}: three numbers are expected, "x y z"')
    return values


def _published(server: MapServer) -> VIMap:
    if server.published is None:
        raise UserError("the server has no map yet")
    return server.published


def _lookup(server: MapServer, given: dict[str, str]) -> Any:
    p_S = point(given.get("p_S", "0 0 0"), "p_S")
    time_ns, sensor = int(given["timestamp_ns"]), given.get("sensor", "")
    return map_lookup(_published(server), given["robot_name"], time_ns, sensor, p_S)


def _dense(server: MapServer, given: dict[str, str]) -> Any:
    center_G, radius_m = point(given["center_G"], "center_G"), float(given["radius_m"])
    kind = server.options.dense_map_resource_type
    folder = server.publisher.folder
    points, clouds = dense_points_in_range(_published(server), folder, kind, center_G, radius_m)
    return {"p_G": points, "resources": clouds}


def _stop(server: MapServer) -> Message:
    server.stop()
    return Message("the server stops: it optimises the map jointly and publishes it")


def _delete(server: MapServer, mission: str) -> DeletedMissions:
    vi_map = _published(server)
    return server.delete_missions({to_hex(vi_map.missions.id[find_mission(vi_map, mission)])})


def _delete_robot(server: MapServer, robot: str) -> DeletedMissions:
    vi_map = _published(server)
    rows = [row for row, name in enumerate(vi_map.missions.name) if name == robot]
    if not rows:
        raise UserError(f"--robot_name={robot}: the map has no mission of it")
    return server.delete_missions({to_hex(vi_map.missions.id[row]) for row in rows})
