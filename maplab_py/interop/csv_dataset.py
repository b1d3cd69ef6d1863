"""maplab's CSV data set: one folder per mission with tables that any tool can read.

Columns follow maplab's page "CSV Dataset Format". Vertex and landmark indices count within the
mission; a landmark is listed with every mission that stores or observes it, so that each
observation finds its landmark.
"""

import dataclasses
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from maplab_py.array_types import F32, I64, U8, NDArray, mask_of
from maplab_py.interop.text_table import format_rows
from maplab_py.options import Options, option
from maplab_py.output_files import check_writable, write_text
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap, ids, ragged_rows

_VERTICES = (
    "vertex index, timestamp [ns], position x [m], position y [m], position z [m], quaternion x, "
    "quaternion y, quaternion z, quaternion w, velocity x [m/s], velocity y [m/s], "
    "velocity z [m/s], acc bias x [m/s^2], acc bias y [m/s^2], acc bias z [m/s^2], "
    "gyro bias x [rad/s], gyro bias y [rad/s], gyro bias z [rad/s]"
)
_IMU = (
    "timestamp [ns], acc x [m/s^2], acc y [m/s^2], acc z [m/s^2], gyro x [rad/s], gyro y [rad/s], "
    "gyro z [rad/s]"
)
_TRACKS = (
    "timestamp [ns], vertex index, frame index, keypoint index, keypoint measurement 0 [px], "
    "keypoint measurement 1 [px], keypoint measurement uncertainty, keypoint scale, "
    "keypoint track id"
)
_LANDMARKS = (
    "landmark index, landmark position x [m], landmark position y [m], landmark position z [m]"
)
_OBSERVATIONS = "vertex index, frame index, keypoint index, landmark index"
_NUMBER = ", %.17g"
_SINGLE = "%.9g"
"""Single precision, so that reading gives back the same number."""
_ROWS_AT_ONCE = 1 << 15


class DescriptorProjector(Protocol):
    """Projection of binary descriptors to few real numbers."""

    @property
    def descriptor_size(self) -> int:
        """Length [bytes] of the descriptors that it takes."""

    def project(self, descriptors: U8) -> F32:
        """Return descriptors (N, bytes) as points (N, dimensions)."""


class CsvExportOptions(Options, prefix="csv_export_"):
    """Tables to write."""

    vertices: bool = True
    """Write vertices.csv"""
    imu_data: bool = True
    """Write imu.csv"""
    tracks_and_keypoints: bool = True
    """Write tracks.csv"""
    descriptors: bool = True
    """Write descriptors.csv (binary descriptors; else empty rows)"""
    landmarks: bool = True
    """Write landmarks.csv"""
    observations: bool = True
    """Write observations.csv"""
    absolute_time: bool = option(False, flag="export_absolute_time")
    """Write time stamps as they are; else relative to the mission's first vertex"""
    only_high_quality_landmarks: bool = option(False, flag="only_export_high_quality_landmarks")
    """Leave out landmarks that are not rated good, and their observations"""


class CsvExportReport(Report):
    """Written files and numbers of rows."""

    folder: Path
    missions: int
    files: int
    vertices: int
    imu_samples: int
    keypoints: int
    landmarks: int
    observations: int


@dataclasses.dataclass(frozen=True, eq=False)
class _Part:
    """The rows of one mission."""

    vertices: I64
    samples: I64
    keypoints: I64
    landmarks: I64
    observations: I64  # keypoint rows
    start_ns: int


def export_csv_dataset(
    vi_map: VIMap,
    folder: Path,
    options: CsvExportOptions,
    *,
    missions: NDArray[np.integer] | None = None,
    projector: DescriptorProjector | None = None,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> CsvExportReport:
    """Write the tables of each mission into `folder/<mission id>`.

    Args:
        folder: Output folder; created if it does not exist.
        projector: Write projected descriptors instead of their bytes; None = bytes.

    Raises:
        UserError: A file exists and `overwrite` is not set (nothing is written then), or a file
            cannot be written.
    """
    rows = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    targets: list[tuple[Path, Iterable[str]]] = []
    counts = np.zeros(5, dtype=np.int64)
    for mission in rows.tolist():
        part = _part_of(vi_map, mission, options)
        home = folder / ids.to_hex(vi_map.missions.id[mission])
        tables = _tables(vi_map, part, options, projector)
        targets.extend((home / f"{name}.csv", chunks) for name, chunks in tables)
        counts += [
            len(part.vertices),
            len(part.samples),
            len(part.keypoints),
            len(part.landmarks),
            len(part.observations),
        ]
    check_writable(*(path for path, _ in targets), overwrite=overwrite)
    for done, (path, chunks) in enumerate(targets):
        progress.check()
        progress.step(done, len(targets), path.name)
        write_text(path, chunks, overwrite=overwrite)
    return CsvExportReport(folder, len(rows), len(targets), *counts.tolist())


def _part_of(vi_map: VIMap, mission: int, options: CsvExportOptions) -> _Part:
    vertices = np.arange(vi_map.vertex_start[mission], vi_map.vertex_start[mission + 1])
    frames = ragged_rows(vi_map.frame_start, vertices)
    keypoints = ragged_rows(vi_map.keypoint_start, frames)
    landmark = vi_map.keypoints.landmark[keypoints]
    wanted = mask_of(len(vi_map.landmarks), landmark[landmark >= 0])
    wanted |= vi_map.vertices.mission[vi_map.landmarks.vertex] == mission
    if options.only_high_quality_landmarks:
        wanted &= vi_map.landmarks.quality == LandmarkQuality.GOOD
    observes = (landmark >= 0) & wanted[np.maximum(landmark, 0)] if len(wanted) else landmark >= 0
    edges = np.flatnonzero(vi_map.vertices.mission[vi_map.imu_edges.from_vertex] == mission)
    edges = edges[np.argsort(vi_map.imu_edges.from_vertex[edges], kind="stable")]
    samples = ragged_rows(vi_map.sample_start, edges)
    # neighbouring edges share the sample at their common vertex
    _, first = np.unique(vi_map.imu_samples.timestamp_ns[samples], return_index=True)
    times = vi_map.vertices.timestamp_ns[vertices]
    start_ns = 0 if options.absolute_time or len(times) == 0 else int(times[0])
    return _Part(
        vertices,
        samples[first],
        keypoints,
        np.flatnonzero(wanted),
        keypoints[observes],
        start_ns,
    )


def _tables(
    vi_map: VIMap,
    part: _Part,
    options: CsvExportOptions,
    projector: DescriptorProjector | None,
) -> list[tuple[str, Iterable[str]]]:
    """Return name and text of every wanted table."""
    tables = [
        (options.vertices, "vertices", _vertices(vi_map, part)),
        (options.imu_data, "imu", _imu(vi_map, part)),
        (options.tracks_and_keypoints, "tracks", _tracks(vi_map, part)),
        (options.descriptors, "descriptors", _descriptors(vi_map, part, projector)),
        (options.landmarks, "landmarks", _landmarks(vi_map, part)),
        (options.observations, "observations", _observations(vi_map, part)),
    ]
    return [(name, text) for is_wanted, name, text in tables if is_wanted]


def _vertices(vi_map: VIMap, part: _Part) -> Iterator[str]:
    rows, table = part.vertices, vi_map.vertices
    T_G_I = vi_map.T_G_I[rows]
    columns: list[NDArray[Any]] = [
        np.arange(len(rows)),
        table.timestamp_ns[rows] - part.start_ns,
        T_G_I[:, 4:],
        T_G_I[:, :4],
        table.v_M[rows],
        table.accel_bias[rows],
        table.gyro_bias[rows],
    ]
    return chain([_VERTICES + "\n"], format_rows("%d, %d" + _NUMBER * 16, columns))


def _imu(vi_map: VIMap, part: _Part) -> Iterator[str]:
    times = vi_map.imu_samples.timestamp_ns[part.samples] - part.start_ns
    columns: list[NDArray[Any]] = [times, vi_map.imu_samples.accel_gyro[part.samples]]
    return chain([_IMU + "\n"], format_rows("%d" + _NUMBER * 6, columns))


def _place(vi_map: VIMap, part: _Part, keypoints: I64) -> tuple[I64, I64, I64]:
    """Return vertex index, frame index and keypoint index of keypoint rows."""
    frame = vi_map.keypoint_frame[keypoints]
    vertex = vi_map.frames.vertex[frame].astype(np.int64)
    first = part.vertices[0] if len(part.vertices) else 0
    index = keypoints - vi_map.keypoint_start[frame]
    return vertex - first, vi_map.frames.camera_index[frame].astype(np.int64), index


def _tracks(vi_map: VIMap, part: _Part) -> Iterator[str]:
    rows, table = part.keypoints, vi_map.keypoints
    times = vi_map.frames.timestamp_ns[vi_map.keypoint_frame[rows]] - part.start_ns
    columns: list[NDArray[Any]] = [
        times,
        *_place(vi_map, part, rows),
        table.uv_px[rows],
        table.sigma_px[rows],
        table.scale[rows],
        table.track_id[rows],
    ]
    places = "%d, %d, %d, %d" + _NUMBER * 4 + ", %d"
    return chain([_TRACKS + "\n"], format_rows(places, columns))


def _descriptors(
    vi_map: VIMap, part: _Part, projector: DescriptorProjector | None
) -> Iterator[str]:
    """Yield descriptors, rows as many as in tracks.csv, without a header.

    The row of a keypoint without a binary descriptor is empty, and with a projector also that of a
    descriptor of another length than it takes.
    """
    sizes = vi_map.binary_descriptor_size[part.keypoints]
    if projector is not None:
        sizes = np.where(sizes == projector.descriptor_size, sizes, 0)
    cuts = np.flatnonzero(np.diff(sizes)) + 1
    for first, run in zip([0, *cuts.tolist()], np.split(part.keypoints, cuts), strict=True):
        if len(run) == 0:
            continue
        size = int(sizes[first])
        if size == 0:
            yield "\n" * len(run)
            continue
        for begin in range(0, len(run), _ROWS_AT_ONCE):
            rows = run[begin : begin + _ROWS_AT_ONCE]
            descriptors = vi_map.keypoints.descriptor[rows, :size]
            if projector is None:
                yield _text_of_bytes(descriptors)
            else:
                points = projector.project(descriptors)
                yield from format_rows(", ".join([_SINGLE] * points.shape[1]), [points])


def _text_of_bytes(descriptors: U8) -> str:
    """Return descriptors (N, bytes) as lines of numbers of three places each."""
    digits = "".join(f"{byte:3d}," for byte in range(256)).encode()
    text = np.frombuffer(digits, dtype=np.uint8).reshape(256, 4)[descriptors]
    text[:, -1, 3] = ord("\n")
    return text.tobytes().decode("ascii")


def _landmarks(vi_map: VIMap, part: _Part) -> Iterator[str]:
    columns: list[NDArray[Any]] = [np.arange(len(part.landmarks)), vi_map.p_G[part.landmarks]]
    return chain([_LANDMARKS + "\n"], format_rows("%d" + _NUMBER * 3, columns))


def _observations(vi_map: VIMap, part: _Part) -> Iterator[str]:
    landmark = np.searchsorted(part.landmarks, vi_map.keypoints.landmark[part.observations])
    columns: list[NDArray[Any]] = [*_place(vi_map, part, part.observations), landmark]
    return chain([_OBSERVATIONS + "\n"], format_rows("%d, %d, %d, %d", columns))
