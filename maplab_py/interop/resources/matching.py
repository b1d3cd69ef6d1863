"""Files with time stamps, matched to the frames of a mission."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import UserError, os_errors_as
from maplab_py.geometry.interpolation import nearest_rows
from maplab_py.report import Report
from maplab_py.sensors import CameraRig
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, mission_sensor_id

MS_TO_NS = 1_000_000


def mission_rig(vi_map: VIMap, mission: int) -> CameraRig:
    """Return the camera rig of a mission (row).

    Raises:
        UserError: It has none.
    """
    rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    if not rig_id:
        raise UserError("the mission has no cameras: choose another one by --map_mission")
    return vi_map.sensors.camera_rig(rig_id)


def camera_frames(vi_map: VIMap, mission: int, camera: int, every_nth: int = 1) -> I64:
    """Return the frames (N,) of a camera (index) at every n-th vertex of a mission, by time."""
    vertex = vi_map.frames.vertex
    start, stop = vi_map.vertex_start[mission : mission + 2]
    chosen = (vertex >= start) & (vertex < stop) & ((vertex - start) % every_nth == 0)
    chosen &= (vi_map.frames.camera_index == camera) & vi_map.frames.is_valid
    rows = np.flatnonzero(chosen)
    return rows[np.argsort(vi_map.frames.timestamp_ns[rows], kind="stable")]


def files_of_frames(
    vi_map: VIMap,
    mission: int,
    camera: int,
    kinds: tuple[int, ...],
    file_times_ns: I64,
    tolerance_ms: float,
    every_nth: int = 1,
) -> tuple[I64, I64, int, int]:
    """Return frames (N,) that lack resources of some types, and their files (N,); see `matched_files`.

    Behind these are the numbers of frames that have a resource, and of those without resource and file.

    Args:
        mission: Row.
        camera: Index in its rig.
        file_times_ns: Times of files (M,), sorted.
        every_nth: Take the frames of every n-th vertex only.
    """
    frames, table = camera_frames(vi_map, mission, camera, every_nth), vi_map.resources
    owned = (table.owner_kind == ResourceOwner.FRAME) & np.isin(table.type, kinds)
    wanted = frames[~np.isin(frames, table.owner[owned])]
    times_ns = vi_map.frames.timestamp_ns[wanted]
    files = matched_files(times_ns, file_times_ns, round(tolerance_ms * MS_TO_NS))
    is_matched = files >= 0
    without = int(np.count_nonzero(~is_matched))
    return wanted[is_matched], files[is_matched], len(frames) - len(wanted), without


def matched_files(frame_times_ns: I64, file_times_ns: I64, tolerance_ns: int) -> I64:
    """Return the file (row) of each frame (N,), -1 where none is near enough.

    A file and a frame match if each is the nearest of the other.

    Args:
        frame_times_ns: Times of frames (N,), sorted.
        file_times_ns: Times of files (M,), sorted.
        tolerance_ns: Largest difference.
    """
    if not len(frame_times_ns) or not len(file_times_ns):
        return np.full(len(frame_times_ns), -1, dtype=np.int64)
    files = nearest_rows(file_times_ns, frame_times_ns)
    back = nearest_rows(frame_times_ns, file_times_ns[files])
    near = np.abs(file_times_ns[files] - frame_times_ns) <= tolerance_ns
    return np.where(near & (back == np.arange(len(files))), files, -1)


def stamped_files(folder: Path, suffixes: tuple[str, ...], flag: str) -> tuple[I64, list[Path]]:
    """Return times (N,) [ns] and paths of files whose names are time stamps, by time.

    Raises:
        UserError: The folder cannot be read, or has no such file, or a name is no stamp.
    """
    with os_errors_as(UserError, f"{flag}={folder}: the folder cannot be read"):
        files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes]
    if not files:
        raise UserError(f"{flag}={folder}: there are no files <time stamp>{'|'.join(suffixes)}")
    for path in sorted(files):
        if not path.stem.isdecimal() or len(path.stem) > 19:
            raise UserError(f"{path}: the name must be the time stamp in nanoseconds")
    files.sort(key=lambda path: (int(path.stem), path.name))
    times = np.array([int(path.stem) for path in files], dtype=np.uint64).astype(np.int64)
    return times, files


class ImportedResources(Report):
    """Files that became resources of a mission; they are written when the map is saved."""

    mission: str
    resource_types: tuple[str, ...]
    files_in_folder: int
    attached: int
    frames_that_had_some: int = dataclasses.field(
        default=0, metadata={"title": "frames with a resource before"}
    )
    frames_without_file: int = 0
    notes: tuple[str, ...] = ()


class ExportedImages(Report):
    """Images that were written as an EuRoC folder."""

    folder: Path
    images: int
    cameras: int
