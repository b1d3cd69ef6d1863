"""Readers of files and requests, each with small valid inputs and what it may end in.

An input is the content of one file. Where a reader knows several kinds of files, the first byte chooses
among their names.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import sqlite3
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from maplab_py.algorithms.self_calibration.segments.database import (
    SegmentDatabase,
    load_database,
    save_database,
)
from maplab_py.errors import MaplabError
from maplab_py.interop import calibration_export, external_closures, g2o, gps, imu_csv, trajectories
from maplab_py.interop.bags.listing import bag_info
from maplab_py.interop.calibration_import import import_calibration
from maplab_py.interop.colmap import features, importing
from maplab_py.interop.colmap.exporting import export_colmap
from maplab_py.interop.colmap.options import ColmapExportOptions
from maplab_py.interop.colmap.reading import read_cameras, read_model
from maplab_py.interop.ply import PlyCloud, encode_ply, parse_ply
from maplab_py.interop.recordings.options import SourceOptions
from maplab_py.interop.recordings.protocol import CameraImage
from maplab_py.interop.recordings.reader_choice import open_recording
from maplab_py.interop.resources.point_clouds import parse_pcd
from maplab_py.interop.wheel_odometry import read_wheel_odometry
from maplab_py.sensors import CameraRig, Imu
from maplab_py.sensors.sensors_yaml import read_sensors, write_sensors
from maplab_py.server.options import MapServerOptions
from maplab_py.server.service import answers
from maplab_py.storage.cache.column_file import UnusableColumns, read_columns, write_columns
from maplab_py.storage.native import load_map, save_map
from tests.fuzz.messages import message_seeds, read_message
from tests.interop import test_clouds_and_meshes as clouds
from tests.interop.calibrations import small_files, test_oddities
from tests.interop.recordings import written
from tests.support.scene import Scene

_MAGIC = b"maplab-py columns 1\n"


@dataclasses.dataclass(frozen=True)
class Reader:
    """A reader under test."""

    seeds: Callable[[Path], list[bytes]]  # valid inputs, made in a folder
    read: Callable[[Path, bytes], None]  # folder for the file, input
    refusals: tuple[type[Exception], ...] = (MaplabError,)
    names_file: bool = True


def check(reader: Reader, folder: Path, data: bytes) -> None:
    """Read an input; whatever is refused is refused in one line that names the file.

    Raises:
        AssertionError: The line is none, or names nothing.
        Exception: The reader failed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # numpy's text is not for the user
            reader.read(folder, data)
    except reader.refusals as error:
        text = str(error)
        assert "\n" not in text, f"several lines: {text!r}"
        if reader.names_file and reader.refusals == (MaplabError,):
            assert str(folder) in text, f"names no file: {text!r}"


def _named(folder: Path, names: tuple[str, ...], data: bytes) -> Path:
    """Write an input under the name that its first byte chooses."""
    path = folder / names[data[0] % len(names)] if data else folder / names[0]
    path.write_bytes(data[1:])
    return path


def _scene() -> Scene:
    return Scene(vertices=3, landmarks=150)  # 5 are seen twice or more


# -- calibrations -------------------------------------------------------------------------------

_CALIBRATIONS = ("c.yaml", "c.json", "camera.txt", "cameras.txt")


def _calibration_seeds(folder: Path) -> list[bytes]:
    texts = [
        *(test_oddities.CAMERA, test_oddities.IMU, test_oddities.EUROC, test_oddities.OLD_IMU),
        *(test_oddities.NCAMERA, test_oddities.OKVIS, small_files.VINS_MONO, small_files.MEI),
        *(small_files.ORB_NEW, small_files.ORB_OLD, small_files.OKVIS, small_files.SVO),
        *(small_files.CAMERA_INFO, small_files.ECHOED, small_files.KANNALA, written.sensor_yaml(0)),
    ]
    seeds = [b"\0" + text.encode() for text in texts]
    sensors = _map().sensors
    ids = [
        next(k for k, v in sensors.sensors.items() if isinstance(v, t)) for t in (Imu, CameraRig)
    ]
    (basalt,) = calibration_export.exported(sensors, *ids, "basalt", imu_rate_hz=200.0).values()
    seeds += [b"\1" + text.encode() for text in (small_files.realsense(), basalt)]
    seeds.append(b"\2RadTan 458 457 320 240 -0.28 0.07 0 0\n640 480\ncrop\n640 480\n")
    seeds.append(b"\3# cameras\n1 OPENCV 640 480 500 500 320 240 0.1 0 0 0\n")
    return seeds


def _read_calibration(folder: Path, data: bytes) -> None:
    path = _named(folder, _CALIBRATIONS, data)
    if path.name == "cameras.txt":
        read_cameras(path)
    else:
        import_calibration(path)
    path.unlink()


def _sensors_seeds(folder: Path) -> list[bytes]:
    return [write_sensors(_scene().make().sensors).encode(), test_oddities.NCAMERA.encode()]


def _read_sensors(folder: Path, data: bytes) -> None:
    path = folder / "sensors.yaml"
    path.write_bytes(data)
    write_sensors(read_sensors(path))


# -- tables -------------------------------------------------------------------------------------

_TABLES = ("trajectory.csv", "imu.csv", "wheels.csv", "times.txt", "closures.yaml")


def _table_seeds(folder: Path) -> list[bytes]:
    stamps = [1403715273262142976 + 50_000_000 * row for row in range(4)]
    tum = "".join(f"{stamp / 1e9:.9f} {row} 0 0 0 0 0 1\n" for row, stamp in enumerate(stamps))
    euroc = "#timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z\n"
    euroc += "".join(f"{stamp},{row},0,0,1,0,0,0\n" for row, stamp in enumerate(stamps))
    imu = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z\n"
    imu += "".join(f"{stamp},0.1,0.2,0.3,0,0,9.8\n" for stamp in stamps)
    wheels = "#timestamp [ns],x,y,yaw\n"
    wheels += "".join(f"{stamp},{row},0,0.1\n" for row, stamp in enumerate(stamps))
    times = "".join(f"{row}.png {stamp}\n" for row, stamp in enumerate(stamps))
    pose = "{translation_m: [0, 0, 1], rotation_xyzw: [1, 0, 0, 0]}"
    end = f"{{timestamp_ns: 1000000000, pose: {pose}}}"
    closures = f"- camera_from: {end}\n  camera_to: {end}\n  T_from_to: {pose}\n"
    closures += f"  covariance: {np.eye(6).tolist()}\n  switch_variable: 1.0\n"
    closures += "  switch_variable_variance: 0.1\n"
    dated = '"time";"x [mm]";"y [mm]";"z [mm]"\n'
    dated += "".join(f"2024-05-06T07:08:0{row}.5Z;{row},5;0;0\n" for row in range(4))
    named = "sec,nanosec,ax [g],ay [g],az [g],gyro.x [deg/s],gyro.y [deg/s],gyro.z [deg/s],t\n"
    named += "".join(f"5,{5_000_000 * row},0,0,1,0,0.1,0,25\n" for row in range(4))
    driven = "time,linear.x [km/h],linear.y,linear.z,angular.x,angular.y,angular.z\n"
    driven += "".join(f"0.{row},7,0,0,0,0,0.1\n" for row in range(4))
    kinds = ((0, tum), (0, euroc), (1, imu), (2, wheels), (3, times), (4, closures))
    kinds += ((0, dated), (1, named), (2, driven))
    return [bytes([kind]) + text.encode() for kind, text in kinds]


def _read_table(folder: Path, data: bytes) -> None:
    path = _named(folder, _TABLES, data)
    readers: tuple[Callable[[Path], object], ...] = (
        lambda file: trajectories.read_trajectory(file, needs_orientation=False),
        *(imu_csv.read_imu_csv, read_wheel_odometry, importing.read_times),
        lambda file: external_closures.read_external_closures(_map(), file),
    )
    readers[_TABLES.index(path.name)](path)


_maps: list[Any] = []


def _map() -> Any:
    if not _maps:
        _maps.append(_scene().make())
    return _maps[0]


def _gps_seeds(folder: Path) -> list[bytes]:
    nmea = (
        "$GPGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,*5B\n"
        "$GPRMC,092725.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A*5E\n"
        "$GPGGA,092726.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,*58\n"
    )
    table = "#timestamp [ns],latitude,longitude,altitude\n1403715273262142976,47.1,8.5,499\n"
    gns = "$GNZDA,092725.00,09,12,2002,00,00\n$GNGNS,092725.00,4717.1,N,00833.9,E,RR,8,1,9,48,,\n"
    rtklib = "% UTC latitude(deg) longitude(deg) height(m)\n2023/11/14 22:13:20.0 47.1 8.5 400\n"
    texts = (table + "1403715274262142976,47.1,8.5,5\n", rtklib)
    return [b"\0" + nmea.encode(), b"\0" + gns.encode(), *(b"\1" + t.encode() for t in texts)]


def _read_gps(folder: Path, data: bytes) -> None:
    gps.read_gps(_named(folder, ("track.nmea", "track.csv"), data))


def _g2o_seeds(folder: Path) -> list[bytes]:
    information = " ".join(["1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"])
    poses = "".join(f"VERTEX_SE3:QUAT {row} {row} 0 0 0 0 0 1\n" for row in range(3))
    edges = "".join(
        f"EDGE_SE3:QUAT {row} {row + 1} 1 0 0 0 0 0 1 {information}\n" for row in range(2)
    )
    flat = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nEDGE_SE2 0 1 1 0 0.1 1 0 0 1 0 1\n"
    return [(poses + edges + "FIX 0\n").encode(), flat.encode()]


def _read_g2o(folder: Path, data: bytes) -> None:
    path = folder / "graph.g2o"
    path.write_bytes(data)
    g2o.read_g2o(path)


# -- clouds -------------------------------------------------------------------------------------


def _ply_seeds(folder: Path) -> list[bytes]:
    p = np.arange(9.0).reshape(3, 3)
    colours = np.arange(9, dtype=np.uint8).reshape(3, 3)
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    text += "property float z\nelement face 1\nproperty list uchar int vertex_indices\n"
    text += "end_header\n0 0 0\n1 1 1\n3 0 1 0\n"
    clouds = (PlyCloud(p), PlyCloud(p, colours=colours), PlyCloud(p, intensity=p[:, 0]))
    return [text.encode(), *(b"".join(encode_ply(cloud)) for cloud in clouds)]


def _read_ply(folder: Path, data: bytes) -> None:
    parse_ply(data, str(folder / "cloud.ply"), 50_000_000)


def _pcd_seeds(folder: Path) -> list[bytes]:
    return [clouds.binary(), clouds.ascii_text()]


def _read_pcd(folder: Path, data: bytes) -> None:
    parse_pcd(data, str(folder / "cloud.pcd"))


# -- COLMAP -------------------------------------------------------------------------------------

_MODEL = ("cameras", "images", "points3D", "rigs", "frames")


def _make_model(folder: Path) -> None:
    export_colmap(_map(), folder / "model", ColmapExportOptions(quality="all"))


def _colmap_seeds(folder: Path) -> list[bytes]:
    """Return the binary files."""
    _make_model(folder)
    files = [(folder / "model" / f"{name}.bin").read_bytes() for name in _MODEL]
    return [bytes([kind]) + content for kind, content in enumerate(files)]


def _read_colmap(folder: Path, data: bytes) -> None:
    """Replace one file of a valid model."""
    source = _prepared(folder, "colmap", _make_model) / "model"
    name = _MODEL[data[0] % len(_MODEL)] if data else _MODEL[0]
    read_model(_replaced(source, folder / "model", f"{name}.bin", data[1:]))


def _replaced(source: Path, target: Path, name: str, content: bytes) -> Path:
    """Return a copy of a folder in which one file has another content."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, copy_function=os.link)
    (target / name).unlink()
    (target / name).write_bytes(content)
    return target


def _database_seeds(folder: Path) -> list[bytes]:
    export_colmap(_map(), folder / "db", ColmapExportOptions(quality="all", colmap_database=True))
    return [(folder / "db" / "database.db").read_bytes()]


def _read_database(folder: Path, data: bytes) -> None:
    path = folder / "database.db"
    path.write_bytes(data)
    images = _keypoints_of(_prepared(folder, "database", _database_seeds))
    list(features.features_of_images(path, *zip(*images, strict=True)))


def _keypoints_of(folder: Path) -> list[tuple[str, np.ndarray]]:
    """Return the names and keypoints (K, 2) of the first images of a valid database."""
    query = "SELECT name, rows, cols, data FROM images JOIN keypoints USING (image_id) WHERE rows > 0 LIMIT 3"
    with contextlib.closing(sqlite3.connect(folder / "db" / "database.db")) as connection:
        return [
            (name, np.frombuffer(data, "<f4").reshape(rows, cols)[:, :2].astype(np.float64))
            for name, rows, cols, data in connection.execute(query)
        ]


def _prepared(folder: Path, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder of valid files that is made once."""
    target = folder / f"valid_{name}"
    if not target.is_dir():
        target.mkdir()
        make(target)
    return target


# -- maps ---------------------------------------------------------------------------------------


def _map_files(folder: Path) -> list[Path]:
    return sorted(path for path in (folder / "map").rglob("*") if path.is_file())


def _make_map(folder: Path) -> None:
    save_map(_map(), folder / "map")


def _map_seeds(folder: Path) -> list[bytes]:
    _make_map(folder)
    return [bytes([row]) + path.read_bytes() for row, path in enumerate(_map_files(folder))]


def _read_map(folder: Path, data: bytes) -> None:
    """Replace one file of a valid map."""
    source = _prepared(folder, "map", _make_map)
    files = _map_files(source)
    chosen = files[data[0] % len(files)] if data else files[0]
    name = str(chosen.relative_to(source / "map"))
    load_map(_replaced(source / "map", folder / "map", name, data[1:]), max_size_megabytes=50)


def _columns_seeds(folder: Path) -> list[bytes]:
    path = folder / "map.columns"
    write_columns(path, _map(), {"missions": 1})
    return [path.read_bytes()]


def _read_columns(folder: Path, data: bytes) -> None:
    """Read a file of columns whose header has its checksum and its time."""
    path = folder / "map.columns"
    start = len(_MAGIC) + 12
    length = (
        int.from_bytes(data[len(_MAGIC) : len(_MAGIC) + 8], "little") if len(data) > start else 0
    )
    header = data[start : start + min(length, len(data))]
    checked = data[: len(_MAGIC) + 8] + struct.pack("<I", zlib.crc32(header)) + data[start:]
    path.write_bytes(checked if len(data) > start else data)
    try:
        written_ns = int(json.loads(header)["written_ns"])
        os.utime(path, ns=(written_ns, written_ns))
    except (ValueError, KeyError, TypeError, OverflowError, OSError, RecursionError):
        pass  # the reader sees it
    read_columns(path, {"missions": 1})


def _segment_seeds(folder: Path) -> list[bytes]:
    """Return whole files (first byte 0), and the text of a header that is put into a file (1)."""
    path = folder / "segments.npz"
    database = SegmentDatabase(_map(), (), {"imu": ("gyro",)}, "trace", 4, (), np.zeros(0))
    save_database(database, path)
    with np.load(path) as archive:
        header = archive["header"].tobytes()
    return [b"\0" + path.read_bytes(), b"\1" + header]


def _read_segments(folder: Path, data: bytes) -> None:
    path = folder / "segments.npz"
    if not data or data[0] % 2 == 0:
        path.write_bytes(data[1:])
    else:
        valid = _prepared(folder, "segments", _segment_seeds) / "segments.npz"
        with np.load(valid) as archive:
            arrays = {name: archive[name] for name in archive.files}
        arrays["header"] = np.frombuffer(data[1:], dtype=np.uint8)
        np.savez(path, **arrays)
    load_database(path, 50_000_000)


# -- recordings ---------------------------------------------------------------------------------


def _make_recording(folder: Path) -> None:
    content = written.make_content(cameras=1, frames=2)
    device = import_calibration(written.write_folder(content, folder / "room"))
    written.write_calibration(device, folder / "sensors.yaml")
    written.write_bag(content, folder / "1.bag")
    written.write_bag(content, folder / "2", version=2)
    written.write_bag(content, folder / "3", version=2, storage="mcap", encoding="png")


_BAGS = ("walk.bag", "walk.db3", "walk.mcap")


def _bag_seeds(folder: Path) -> list[bytes]:
    _make_recording(folder)
    files = [folder / "1.bag", *(folder / "2").glob("*.db3"), *(folder / "3").glob("*.mcap")]
    return [bytes([row]) + path.read_bytes() for row, path in enumerate(files)]


def _read_bag(folder: Path, data: bytes) -> None:
    source = _prepared(folder, "recording", _make_recording)
    path = _named(folder, _BAGS, data)
    bag_info(path)
    _decode(open_recording(path, SourceOptions(source / "sensors.yaml")))


def _decode(recording: Any) -> None:
    for item in recording.items():
        if isinstance(item, CameraImage):
            item.grey()


_FOLDER_FILES = ("cam0/data.csv", "imu0/data.csv", "cam0/sensor.yaml", "imu0/sensor.yaml")


def _folder_seeds(folder: Path) -> list[bytes]:
    _make_recording(folder)
    mav0 = folder / "room" / "mav0"
    return [bytes([row]) + (mav0 / name).read_bytes() for row, name in enumerate(_FOLDER_FILES)]


def _read_folder(folder: Path, data: bytes) -> None:
    source = _prepared(folder, "recording", _make_recording)
    name = _FOLDER_FILES[data[0] % len(_FOLDER_FILES)] if data else _FOLDER_FILES[0]
    _decode(open_recording(_replaced(source / "room" / "mav0", folder / "mav0", name, data[1:])))


# -- requests of the map server -----------------------------------------------------------------


def _request_seeds(folder: Path) -> list[bytes]:
    requests: list[dict[str, object]] = [
        {"request": "map_lookup", "robot_name": "", "timestamp_ns": 5, "p_S": "1 2 3"},
        {"request": "get_dense_map_in_range", "center_G": "0 0 0", "radius_m": 5},
        {"request": "delete_mission", "mission": "ab"},
        {"request": "delete_all_robot_missions", "robot_name": "a"},
    ]
    return [json.dumps(request).encode() for request in requests]


def _read_request(folder: Path, data: bytes) -> None:
    """Answer a request as the service does, which passes on what its `except` clauses name."""
    try:
        content = json.loads(data)
        parameters = {str(key): str(value) for key, value in content.items()}
    except (ValueError, AttributeError, RecursionError):
        return
    server: Any = SimpleNamespace(
        published=_map(),
        options=MapServerOptions(),
        publisher=SimpleNamespace(folder=folder),
        call=lambda function: function(),
        delete_missions=len,
    )
    reads, writes = answers(server)
    del reads["serve_status"], writes["serve_stop"]
    answer = {**reads, **writes}.get(parameters.pop("request", ""))
    if answer is not None:
        answer(parameters)


READERS = {
    "sensors": Reader(_sensors_seeds, _read_sensors),
    "calibrations": Reader(_calibration_seeds, _read_calibration),
    "tables": Reader(_table_seeds, _read_table),
    "gps": Reader(_gps_seeds, _read_gps),
    "g2o": Reader(_g2o_seeds, _read_g2o),
    "ply": Reader(_ply_seeds, _read_ply),
    "pcd": Reader(_pcd_seeds, _read_pcd),
    "colmap": Reader(_colmap_seeds, _read_colmap),
    "colmap_database": Reader(_database_seeds, _read_database),
    "map": Reader(_map_seeds, _read_map),
    "columns": Reader(_columns_seeds, _read_columns, (UnusableColumns, OSError)),
    "segments": Reader(_segment_seeds, _read_segments),
    "bags": Reader(_bag_seeds, _read_bag),
    "folder": Reader(_folder_seeds, _read_folder),
    "messages": Reader(message_seeds, read_message, names_file=False),
    "requests": Reader(_request_seeds, _read_request, (MaplabError, KeyError, ValueError)),
}
