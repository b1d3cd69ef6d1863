"""Load a native map folder."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.errors import MapError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors.sensors_yaml import read_sensors
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage import reading, reading_frames, reading_resources
from maplab_py.storage.atomic import recover
from maplab_py.storage.checksums import verify
from maplab_py.storage.files import SENSORS, VI_MAP_FOLDER, listed_files, read_message
from maplab_py.storage.reading import Content, required_rows, unique_index
from maplab_py.storage.words import ids_of
from maplab_py.vimap import TransformationKind, VIMap
from maplab_py.vimap.ids import IdIndex, is_valid
from maplab_py.vimap.table import starts_of_counts

I64 = NDArray[np.int64]

_TRANSFORMATIONS = {
    "odometry": TransformationKind.ODOMETRY,
    "transformation": TransformationKind.TRANSFORMATION,
    "wheel_odometry": TransformationKind.WHEEL_ODOMETRY,
}


@dataclasses.dataclass(frozen=True)
class LoadReport(Report):
    """What was loaded."""

    folder: str
    files: int
    megabytes: float  # unpacked
    missions: int
    vertices: int
    landmarks: int
    keypoints: int
    notes: list[str]
    seconds: float


def load_map(
    folder: Path,
    *,
    max_size_megabytes: int = 2000,
    repair: bool = False,
    progress: Progress = SILENT,
) -> tuple[VIMap, LoadReport]:
    """Load a map; nothing is returned unless everything fits.

    Args:
        folder: Map folder.
        max_size_megabytes: Bound of the unpacked size of one file.
        repair: Where the two copies of an observation disagree, keep what both say.
        progress: Shown while reading.

    Raises:
        MapError: A file is missing or damaged, or entities do not fit together; one line that
            names file and field.
    """
    began = time.perf_counter()
    folder = Path(folder)
    recover(folder)
    files = listed_files(folder)
    verify(folder)
    max_bytes = max_size_megabytes * 1_000_000
    messages, total = [], 0
    for index, path in enumerate(files):
        progress.step(index, len(files) + 1, "read files")
        message = pb.VIMap()
        total += read_message(path, message, max_bytes)
        messages.append(message)
    sensors = read_sensors(folder / VI_MAP_FOLDER / SENSORS)
    try:
        vi_map, notes = _assemble(folder, _content(messages), repair, max_bytes)
    except MapError as error:
        text = str(error)
        raise error if str(folder) in text else MapError(f"{folder}: {text}") from error
    vi_map = vi_map.replace(sensors=sensors)
    progress.step(1, 1, "read files")
    report = LoadReport(
        folder=str(folder),
        files=len(files),
        megabytes=total / 1e6,
        missions=len(vi_map.missions),
        vertices=len(vi_map.vertices),
        landmarks=len(vi_map.landmarks),
        keypoints=len(vi_map.keypoints),
        notes=notes,
        seconds=time.perf_counter() - began,
    )
    return vi_map, report


def _content(messages: list[pb.VIMap]) -> Content:
    """Join the messages of all files; ids and entities must come in pairs."""
    joined: dict[str, Any] = {}
    for name, ids in (
        ("vertices", "vertex_ids"),
        ("edges", "edge_ids"),
        ("missions", "mission_ids"),
        ("baseframes", "baseframe_ids"),
    ):
        joined[name] = [entity for m in messages for entity in getattr(m, name)]
        joined[ids] = ids_of((i for m in messages for i in getattr(m, ids)), ids)
        if len(joined[name]) != len(joined[ids]):
            raise MapError(f"there are {len(joined[name])} {name} but {len(joined[ids])} {ids}")
    entries = [entry for m in messages for entry in m.landmark_index]
    return Content(
        **joined,
        legacy_landmark_ids=ids_of(
            (i for m in messages for i in m.legacy_landmark_ids), "legacy landmark ids"
        ),
        index_vertex_ids=ids_of([e.vertex_id for e in entries], "landmark index"),
        index_landmark_ids=ids_of([e.landmark_id for e in entries], "landmark index"),
    )


def _assemble(
    folder: Path, content: Content, repair: bool, max_bytes: int
) -> tuple[VIMap, list[str]]:
    """Make the tables; vertex rows sorted by mission, then time."""
    unique_index(content.vertex_ids, "vertex")
    unique_index(content.edge_ids, "edge")
    mission_index = unique_index(content.mission_ids, "mission")
    baseframe_index = unique_index(content.baseframe_ids, "base frame")
    mission = required_rows(
        mission_index,
        ids_of([v.mission_id for v in content.vertices], "mission of a vertex"),
        "the mission of a vertex",
    )
    times = _vertex_times(content)
    order = np.lexsort((times, mission))
    vertices = [content.vertices[k] for k in order]
    vertex_table = reading.read_vertices(content, order, mission[order], times[order])
    vertex_index = IdIndex(vertex_table.id)
    frames = reading_frames.read_frames(vertices)
    landmarks, observers, frame_index, keypoint_index, owner = reading_frames.read_landmarks(
        vertices
    )
    landmark_index = unique_index(landmarks.id, "landmark")
    frame_start = starts_of_counts(np.bincount(frames.frames.vertex, minlength=len(vertices)))
    frames = _with_current_ids(frames, content)
    listed = _listed_keypoints(frames, frame_start, vertex_index, observers, frame_index)
    keypoint = np.where(
        keypoint_index < listed[1], listed[0] + keypoint_index, -1
    )  # beyond the frame's keypoints: no such observation
    keypoint[listed[0] < 0] = -1
    linked, notes = reading_frames.linked_keypoints(
        frames, landmark_index, (keypoint, owner), repair=repair
    )
    notes += _check_landmark_index(content, landmarks, vertex_table.id, landmark_index, repair)
    inertial = [(k, e.imu) for k, e in enumerate(content.edges) if e.HasField("imu")]
    imu_edges, samples = reading.read_imu_edges(
        content.edge_ids[[k for k, _ in inertial]], [e for _, e in inertial], vertex_index
    )
    vi_map = VIMap(
        metadata=reading_resources.read_metadata(folder),
        missions=reading.read_missions(content, baseframe_index, vertex_index),
        baseframes=reading.read_baseframes(content),
        vertices=vertex_table,
        frames=frames.frames,
        keypoints=frames.keypoints.replace(landmark=linked),
        landmarks=landmarks,
        imu_edges=imu_edges,
        imu_samples=samples,
        absolute_poses=reading.read_absolute_poses(vertices),
        resources=reading_resources.read_resources(
            folder, vertices, content.missions, frame_start, max_bytes
        ),
    )
    return _with_relative_edges(vi_map, content, vertex_index), notes


def _with_relative_edges(vi_map: VIMap, content: Content, vertex_index: IdIndex) -> VIMap:
    relative = [
        (k, kind, getattr(edge, name))
        for k, edge in enumerate(content.edges)
        for name, kind in _TRANSFORMATIONS.items()
        if edge.HasField(name)
    ]
    loops = [(k, e.loop_closure) for k, e in enumerate(content.edges) if e.HasField("loop_closure")]
    empty = [k for k, e in enumerate(content.edges) if not e.ListFields()]
    if empty:
        raise MapError(f"{len(empty)} edges hold no known kind of measurement")
    return vi_map.replace(
        transformation_edges=reading.read_transformation_edges(
            [kind for _, kind, _ in relative],
            content.edge_ids[[k for k, _, _ in relative]],
            [e for _, _, e in relative],
            vertex_index,
        ),
        loop_closure_edges=reading.read_loop_closures(
            content.edge_ids[[k for k, _ in loops]], [e for _, e in loops], vertex_index
        ),
    )


def _vertex_times(content: Content) -> I64:
    """Return the time of every vertex (file order): of its first set frame, else of IMU edges."""
    times = np.full(len(content.vertices), np.iinfo(np.int64).min)
    for row, vertex in enumerate(content.vertices):
        stamps = [f.timestamp_ns for f in vertex.nframe.frames if any(f.id.words)]
        if stamps:
            times[row] = min(stamps)
    unset = np.flatnonzero(times == np.iinfo(np.int64).min)
    if len(unset):
        index = IdIndex(content.vertex_ids)
        for edge in content.edges:
            if edge.HasField("imu") and len(edge.imu.timestamps_ns):
                ends = ids_of([edge.imu.from_vertex_id, edge.imu.to_vertex_id], "ends of an edge")
                for row, stamp in zip(
                    index.rows(ends), (edge.imu.timestamps_ns[0], edge.imu.timestamps_ns[-1]),
                    strict=True,
                ):  # fmt: skip
                    if row >= 0 and times[row] == np.iinfo(np.int64).min:
                        times[row] = stamp
        times[times == np.iinfo(np.int64).min] = 0
    return times


def _with_current_ids(
    frames: reading_frames.FrameContent, content: Content
) -> reading_frames.FrameContent:
    """Rewrite the global landmark ids of 1.x maps: the n-th old id stands for the n-th entry."""
    legacy = content.legacy_landmark_ids
    if not len(legacy):
        return frames
    if len(legacy) != len(content.index_landmark_ids):
        raise MapError(
            f"the landmark index has {len(legacy)} old ids for "
            f"{len(content.index_landmark_ids)} entries"
        )
    rows = IdIndex(legacy).rows(frames.landmark_ids)
    known = is_valid(frames.landmark_ids) & (rows >= 0)
    ids = frames.landmark_ids.copy()
    ids[known] = content.index_landmark_ids[rows[known]]
    return dataclasses.replace(frames, landmark_ids=ids)


def _listed_keypoints(
    frames: reading_frames.FrameContent,
    frame_start: I64,
    vertex_index: IdIndex,
    observers: NDArray[np.uint64],
    frame_index: I64,
) -> tuple[I64, I64]:
    """Return the first keypoint row of the frame of each listed observation, and its count.

    Rows are -1 for vertices or frames that do not exist.
    """
    vertex = vertex_index.rows(observers)
    exists = vertex >= 0
    safe = np.where(exists, vertex, 0)
    if not len(frame_start) > 1:
        return np.full(len(vertex), -1), np.zeros(len(vertex), dtype=np.int64)
    exists &= frame_index < frame_start[safe + 1] - frame_start[safe]
    frame = np.where(exists, frame_start[safe] + frame_index, 0)
    counts = frames.frames.keypoint_count
    if not len(counts):
        return np.full(len(vertex), -1), np.zeros(len(vertex), dtype=np.int64)
    first = starts_of_counts(counts)[frame]
    return np.where(exists, first, -1), np.where(exists, counts[frame], 0)


def _check_landmark_index(
    content: Content,
    landmarks: Any,
    vertex_ids: NDArray[np.uint64],
    landmark_index: IdIndex,
    repair: bool,
) -> list[str]:
    """Compare the index (landmark -> storing vertex) with where landmarks are."""
    if not len(content.index_landmark_ids) and not len(landmarks):
        return []
    rows = landmark_index.rows(content.index_landmark_ids)
    known = np.flatnonzero(rows >= 0)
    stored_at = vertex_ids[landmarks.vertex[rows[known]]]
    wrong = len(rows) - len(known)
    wrong += int(np.count_nonzero((stored_at != content.index_vertex_ids[known]).any(axis=1)))
    wrong += len(landmarks) - len(np.unique(rows[known]))
    if not wrong:
        return []
    if not repair:
        raise MapError(
            f"the landmark index disagrees with {wrong} stored landmarks; load with --repair to "
            "believe the vertices"
        )
    return [f"{wrong} entries of the landmark index repaired"]
