"""Point clouds of other programs as resources of a sensor at a time."""

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError, UserError, os_errors_as
from maplab_py.input_files import DEFAULT_MAX_BYTES, read_bytes
from maplab_py.interop import ply
from maplab_py.interop.resources.matching import ImportedResources, stamped_files
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.sensors import CameraRig
from maplab_py.storage.resources.new import NewResources
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, from_hex, queries, to_hex

# Source: The PCD file format, documentation of PCL, version 0.7.

_TYPES = {"F": "f", "I": "i", "U": "u"}
_MAX_HEADER_BYTES = 100_000
_MAX_POINTS = 100_000_000
_SINGLE = ("x", "y", "z", *ply.INTENSITIES, "rgb", "rgba", "red", "green", "blue", "r", "g", "b")
"""Fields of one value."""


def parse_pcd(data: bytes, source: str) -> ply.PlyCloud:
    """Read the content of a PCD file (ascii or binary); points with NaN are left out.

    Raises:
        MapError: It is not PCD with x, y, z, it ends early, or it is compressed; names the source.
    """
    header, begin = _header(data, source)
    dtype = _point_type(header, source)
    try:
        count = int(header["POINTS"][0])
    except (KeyError, ValueError, IndexError):
        raise MapError(f"{source}: the PCD header has no number of POINTS") from None
    if not 0 <= count <= _MAX_POINTS:
        raise MapError(f"{source}: the PCD header names {count} points; take fewer")
    form = next(iter(header.get("DATA", [])), "")
    if form == "binary_compressed":
        raise MapError(f"{source}: compressed PCD is not read: save it as binary or ascii")
    if form not in ("ascii", "binary"):
        raise MapError(f"{source}: the PCD header has no line DATA ascii or DATA binary")
    if any(dtype[name].shape for name in dtype.names or () if name in _SINGLE):
        raise MapError(
            f"{source}: the PCD header gives a coordinate, intensity or colour several values (COUNT)"
        )
    try:
        if form == "binary":
            table = np.frombuffer(data, dtype=dtype, count=count, offset=begin)
        else:
            text = data[begin:].decode("ascii", errors="replace")
            lines = [line for line in text.splitlines() if line.strip()][:count]
            if len(lines) < count:
                raise ValueError(f"{len(lines)} of {count} lines")
            table = (
                np.loadtxt(lines, dtype=dtype, ndmin=1, comments=None)
                if lines
                else np.zeros(0, dtype)
            )
    except ValueError as error:
        raise MapError(f"{source}: the PCD data end early or do not fit ({error})") from None
    cloud = ply.cloud_of_table(table)
    return cloud.where(np.isfinite(cloud.p).all(axis=1))


def _header(data: bytes, source: str) -> tuple[dict[str, list[str]], int]:
    """Return the words behind each key, and where the data begin."""
    place = data.find(b"DATA", 0, _MAX_HEADER_BYTES)
    begin = data.find(b"\n", place) + 1
    if place < 0 or begin == 0 or b"FIELDS" not in data[:place]:
        raise MapError(f"{source}: this is not a PCD file")
    lines = data[:begin].decode("ascii", errors="replace").splitlines()
    words = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    return {line[0]: line[1:] for line in words}, begin


def _point_type(header: dict[str, list[str]], source: str) -> np.dtype[np.void]:
    names = header.get("FIELDS", [])
    counts = header.get("COUNT", ["1"] * len(names))
    try:
        fields = []
        for number, (name, size, kind, count) in enumerate(
            zip(names, header["SIZE"], header["TYPE"], counts, strict=True)
        ):
            unique = name if name != "_" and name not in names[:number] else f"_{number}"
            fields.append((unique, f"<{_TYPES[kind]}{int(size)}", (int(count),)))
        plain = [
            (name, kind) if shape == (1,) else (name, kind, shape) for name, kind, shape in fields
        ]
        dtype: np.dtype[np.void] = np.dtype(plain)
    except (KeyError, ValueError, TypeError):
        raise MapError(f"{source}: FIELDS, SIZE, TYPE and COUNT of the PCD header differ") from None
    if not {"x", "y", "z"} <= set(dtype.names or ()):
        raise MapError(f"{source}: the PCD file has no points with x, y, z")
    return dtype


XYZ, XYZRGB, XYZI = 16, 17, 21
"""Numbers of the resource types of clouds: plain, with colours, with intensities."""


def import_point_clouds(
    vi_map: VIMap,
    mission: int,
    folder: Path,
    sensor_id: str = "",
    *,
    progress: Progress = SILENT,
) -> tuple[VIMap, ImportedResources]:
    """Attach clouds (PLY or PCD, named by time stamp) to a sensor of a mission (row).

    Points are in the frame of the sensor at the time of the stamp. Clouds of times outside the
    mission are left out, as are those of times that the sensor has a cloud of.

    Args:
        folder: Has the files <time stamp in ns>.ply or .pcd.
        sensor_id: Sensor, or an unambiguous prefix; empty = the mission's lidar.

    Raises:
        UserError: There are no files, no such sensor, or no file is of a time of the mission.
        MapError: A file is damaged or has no points.
    """
    times, files = stamped_files(folder, (".ply", ".pcd"), "--point_cloud_folder")
    vi_map, report, outside = attach_clouds(
        vi_map,
        mission,
        sensor_id,
        times,
        lambda rows: (partial(read_cloud, files[row]) for row in rows.tolist()),
        f"--point_cloud_folder={folder}",
        "check --map_mission",
        progress,
    )
    if not outside:
        return vi_map, report
    note = f"{outside} files are of times outside the mission"
    return vi_map, dataclasses.replace(report, notes=(note, *report.notes))


def attach_clouds(
    vi_map: VIMap,
    mission: int,
    sensor_id: str,
    times_ns: I64,
    read: Callable[[I64], Iterable[Callable[[], ply.PlyCloud]]],
    source: str,
    remedy: str,
    progress: Progress,
) -> tuple[VIMap, ImportedResources, int]:
    """Attach clouds to a sensor of a mission (row), and count those of times outside the mission.

    Clouds without finite points, and of times of which the sensor has one, are left out.

    Args:
        sensor_id: Sensor, or an unambiguous prefix; empty = the mission's lidar.
        times_ns: Times (N,) of the clouds.
        read: Yields what reads each cloud of some rows.
        source: Name of where they come from, for messages.
        remedy: Helps where all are of other times.

    Raises:
        UserError: There is no such sensor, or no cloud is of a time of the mission.
        MapError: A cloud is damaged, or all are empty.
    """
    sensor, table = chosen_sensor(vi_map, mission, sensor_id), vi_map.resources
    first_ns, last_ns = queries.mission_time_spans_ns(vi_map)[mission].tolist()
    inside = (times_ns >= first_ns) & (times_ns <= last_ns)
    if not inside.any():
        raise UserError(
            f"{source}: no stamp is within the mission, which goes from {first_ns} to {last_ns} ns: {remedy}"
        )
    known = (table.owner_kind == ResourceOwner.SENSOR) & np.isin(table.type, (XYZ, XYZRGB, XYZI))
    known &= np.all(table.sensor_id == from_hex(sensor), axis=1)
    chosen = np.flatnonzero(inside & ~np.isin(times_ns, table.timestamp_ns[known]))
    new = NewResources(seed=vi_map.missions.id[mission].tobytes())
    kept: list[int] = []
    problem: ply.EmptyCloud | None = None
    for row, load in zip(chosen.tolist(), read(chosen), strict=True):
        progress.step(len(kept), len(chosen), "point clouds")
        try:
            cloud = load()
        except ply.EmptyCloud as error:
            problem = problem or error
            continue
        kind = XYZ if cloud.intensity is None else XYZI
        new.add(kind if cloud.colours is None else XYZRGB, b"".join(ply.encode_ply(cloud)))
        kept.append(row)
    if problem is not None and not kept:
        raise problem
    if kept:
        vi_map = new.attached(
            vi_map,
            np.arange(len(kept)),
            np.full(len(kept), mission),
            ResourceOwner.SENSOR,
            sensor_id=from_hex(sensor),
            timestamp_ns=times_ns[kept],
        )
    empty, outside = len(chosen) - len(kept), int(np.count_nonzero(~inside))
    had_some = len(times_ns) - outside - len(chosen)
    notes = (f"{counted(empty, 'cloud')} without finite points left out",) if empty else ()
    mission_id = to_hex(vi_map.missions.id[mission])
    report = ImportedResources(
        mission_id, new.type_names, len(times_ns), len(kept), had_some, notes=notes
    )
    return vi_map, report, outside


def read_cloud(path: Path) -> ply.PlyCloud:
    """Read a PLY or PCD file.

    Raises:
        MapError: It cannot be read, is damaged or has no points.
    """
    with os_errors_as(MapError, f"{path}: the cloud cannot be read"):
        data = read_bytes(path, DEFAULT_MAX_BYTES, remedy="split it", error=MapError)
    parse = parse_pcd if path.suffix.lower() == ".pcd" else ply.parse_ply
    cloud = parse(data, str(path))
    valid = np.isfinite(cloud.p).all(axis=1)
    if not valid.any():
        problem = "is not finite" if len(cloud.p) else "is empty"
        raise ply.EmptyCloud(f"{path}: the cloud {problem}: remove the file, or export it again")
    return cloud if valid.all() else cloud.where(valid)


def chosen_sensor(vi_map: VIMap, mission: int, prefix: str) -> str:
    """Return the id of the sensor that a prefix names; without a prefix of the mission's lidar.

    Raises:
        UserError: The prefix names none or several, or the mission has no lidar.
    """
    if not prefix:
        lidar = queries.mission_sensor_id(vi_map, mission, MissionSensor.LIDAR)
        if not lidar:
            raise UserError("the mission has no lidar: name the sensor by --sensor_id")
        return lidar
    rigs = [s for s in vi_map.sensors.sensors.values() if isinstance(s, CameraRig)]
    cameras = [camera.id for rig in rigs for camera in rig.cameras]
    known = [*vi_map.sensors.sensors, *cameras]
    matches = [key for key in known if key.startswith(prefix.lower())]
    if len(matches) != 1:
        kind = "ambiguous" if matches else "unknown"
        raise UserError(f"--sensor_id={prefix} is {kind}: the map has {', '.join(known)}")
    return matches[0]
