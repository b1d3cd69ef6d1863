"""JSON over HTTP: status, stop, deletion and look-ups. On loopback, or with a token elsewhere."""

from __future__ import annotations

import json
import os
import secrets
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import parse_qsl, urlsplit

import numpy as np

from maplab_py.array_types import F64
from maplab_py.atomic import write_file
from maplab_py.errors import MapError, MaplabError, UserError
from maplab_py.geometry import interpolation, se3
from maplab_py.report import Message, to_json
from maplab_py.server.options import DeletedMissions, LookupReport
from maplab_py.storage.resources.types import resource_type
from maplab_py.vimap import MissionSensor, VIMap, to_hex
from maplab_py.vimap.queries import find_mission, mission_sensor_id, resources_of

if TYPE_CHECKING:
    from maplab_py.server.server import MapServer


LOOPBACK = "127.0.0.1"
_MAX_BODY = 100_000
_LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")

Answer = Callable[[dict[str, str]], Any]
"""Takes the parameters of a request; returns a report or plain values."""


class Service:
    """Answers requests in threads of its own while the block lasts."""

    def __init__(
        self,
        reads: dict[str, Answer],
        writes: dict[str, Answer],
        *,
        address: str,
        port: int,
        file: Path,
    ) -> None:
        """Prepare.

        Args:
            reads: Answers to GET by name.
            writes: Answers to POST by name.
            address: Address to listen at.
            port: Its port, 0 = any.
            file: Gets address, token and process, readable to the user alone.

        Raises:
            UserError: It cannot listen there.
        """
        # what requests must carry; empty on loopback
        self.token = "" if address == LOOPBACK else secrets.token_urlsafe(24)
        handler = type(
            "_BoundHandler", (_Handler,), {"reads": reads, "writes": writes, "token": self.token}
        )
        try:
            self._server = ThreadingHTTPServer((address, port), handler)
        except (OSError, OverflowError) as error:
            raise UserError(
                f"--serve_address={address} --serve_port={port}: cannot listen there ({error})"
            ) from error
        self._server.daemon_threads = True
        self.url = f"http://{address}:{self._server.server_address[1]}"  # where it listens
        self._file = file
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )

    def __enter__(self) -> Self:
        content = {"url": self.url, "token": self.token, "process": os.getpid()}
        write_file(self._file, [b""])
        self._file.chmod(0o600)  # the permissions stay when the content comes
        write_file(self._file, [json.dumps(content).encode()])
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._file.unlink(missing_ok=True)


class _Handler(BaseHTTPRequestHandler):
    reads: dict[str, Answer]
    writes: dict[str, Answer]
    token: str
    timeout = 30.0

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        self._answer(self.reads, parts.path, dict(parse_qsl(parts.query)))

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        is_json = self.headers.get_content_type() == "application/json"
        if not is_json or not length.isdigit() or int(length) > _MAX_BODY:
            self._send(400, {"error": "a JSON object is expected"})
            return
        try:
            content = json.loads(self.rfile.read(int(length)))
            parameters = {str(key): str(value) for key, value in content.items()}
        except (ValueError, AttributeError):
            self._send(400, {"error": "a JSON object is expected"})
            return
        self._answer(self.writes, urlsplit(self.path).path, parameters)

    def _answer(self, answers: dict[str, Answer], path: str, parameters: dict[str, str]) -> None:
        if not self._is_allowed():
            self._send(403, {"error": "not allowed: the token is missing or wrong"})
            return
        answer = answers.get(path.strip("/"))
        if answer is None:
            names = ", ".join(sorted((*self.reads, *self.writes)))
            self._send(404, {"error": f"{path}: there is only {names}"})
            return
        try:
            self._send(200, to_json(answer(parameters)))
        except KeyError as error:
            self._send(400, {"error": f"the parameter {error.args[0]} is missing"})
        except (MaplabError, ValueError) as error:
            self._send(400, {"error": str(error)})

    def _is_allowed(self) -> bool:
        if self.token:
            given = self.headers.get("Authorization", "").removeprefix("Bearer ")
            return secrets.compare_digest(given.encode(), self.token.encode())
        host = self.headers.get("Host", "").rsplit(":", 1)[0]
        return host in _LOCAL_NAMES  # no page of another name that resolves to this machine

    def _send(self, status: int, content: Any) -> None:
        data = json.dumps(content).encode()
        try:
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)
        except OSError:  # the other side has gone
            self.close_connection = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Write nothing."""


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


def _publish(server: MapServer) -> VIMap:
    if server.published is None:
        raise UserError("the server has no map yet")
    return server.published


def _lookup(server: MapServer, given: dict[str, str]) -> Any:
    p_S = point(given.get("p_S", "0 0 0"), "p_S")
    time_ns, sensor = int(given["timestamp_ns"]), given.get("sensor", "")
    return map_lookup(_publish(server), given["robot_name"], time_ns, sensor, p_S)


def _dense(server: MapServer, given: dict[str, str]) -> Any:
    center_G, radius_m = point(given["center_G"], "center_G"), float(given["radius_m"])
    kind = server.options.dense_map_resource_type
    folder = server.publisher.folder
    points, clouds = dense_points_in_range(_publish(server), folder, kind, center_G, radius_m)
    return {"p_G": points, "resources": clouds}


def _stop(server: MapServer) -> Message:
    server.stop()
    return Message("the server stops: it optimises the map jointly and publishes it")


def _delete(server: MapServer, mission: str) -> DeletedMissions:
    vi_map = _publish(server)
    return server.delete_missions({to_hex(vi_map.missions.id[find_mission(vi_map, mission)])})


def _delete_robot(server: MapServer, robot: str) -> DeletedMissions:
    vi_map = _publish(server)
    rows = [row for row, name in enumerate(vi_map.missions.name) if name == robot]
    if not rows:
        raise UserError(f"--robot_name={robot}: the map has no mission of it")
    return server.delete_missions({to_hex(vi_map.missions.id[row]) for row in rows})


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
    T_G_I, _ = interpolation.interpolate_poses(
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
