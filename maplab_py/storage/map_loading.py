"""Load a native map folder and convert its messages to a VI-map."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64
from maplab_py.atomic import recover
from maplab_py.errors import MapError
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors.sensors_yaml import read_sensors
from maplab_py.storage import frames_from_messages, resources_from_messages, tables_from_messages
from maplab_py.storage import maplab_map_pb2 as pb
from maplab_py.storage.checksums import verify
from maplab_py.storage.load_checks import (
    absent_parts,
    check_files,
    check_listed_edges,
    check_records,
    consistency_notes,
    edge_kinds,
)
from maplab_py.storage.map_files import SENSORS, VI_MAP_FOLDER, listed_files, read_message
from maplab_py.storage.message_ids import ids_of
from maplab_py.storage.message_scan import MemoryBudget
from maplab_py.storage.mission_names import with_names
from maplab_py.storage.tables_from_messages import Content, required_rows, unique_index
from maplab_py.vimap import TransformationKind, VIMap
from maplab_py.vimap.ids import IdIndex, is_valid
from maplab_py.vimap.table import starts_of_counts

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
    """Load a map and check that it is consistent.

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
    with contextlib.suppress(OSError):  # a name with no room for that of an unfinished save
        recover(folder)
    budget = MemoryBudget(max_size_megabytes * 1_000_000)
    try:
        with _no_collection():
            vi_map, files, total, notes = _load(folder, budget, repair, progress)
    except MapError as error:
        text = str(error)
        raise error if str(folder) in text else MapError(f"{folder}: {text}") from error
    except OSError as error:
        raise MapError(f"{folder}: cannot be read ({error.strerror})") from error
    except MemoryError as error:
        raise MapError(
            f"{folder}: does not fit into memory; end other programs or load parts of it"
        ) from error
    report = LoadReport(
        folder=str(folder),
        files=files,
        megabytes=total / 1e6,
        missions=len(vi_map.missions),
        vertices=len(vi_map.vertices),
        landmarks=len(vi_map.landmarks),
        keypoints=len(vi_map.keypoints),
        notes=notes,
        seconds=time.perf_counter() - began,
    )
    return vi_map, report


def _load(
    folder: Path, budget: MemoryBudget, repair: bool, progress: Progress
) -> tuple[VIMap, int, int, list[str]]:
    """Return the map, the number of its files and their unpacked bytes, and notes."""
    files = listed_files(folder, budget.max_bytes)
    verify(folder)
    messages, total = [], 0
    for index, (_, path) in enumerate(files):
        progress.step(index, len(files) + 1, "read files")
        message = pb.VIMap()
        total += read_message(path, message, budget)
        messages.append(message)
    check_files(files, messages)
    sensors = read_sensors(folder / VI_MAP_FOLDER / SENSORS, budget.max_bytes)
    content = _content(messages, [path for _, path in files])
    check_records(content, budget.max_bytes)
    vi_map, notes = _assemble(folder, content, repair, budget)
    vi_map = vi_map.replace(sensors=sensors)
    vi_map = with_names(vi_map, folder)
    notes += absent_parts(folder, vi_map) + consistency_notes(vi_map)
    progress.step(1, 1, "read files")
    return vi_map, len(files), total, notes


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Disable the garbage collector: there are very many messages and no reference cycles."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _content(messages: list[pb.VIMap], paths: list[Path]) -> Content:
    """Concatenate the messages of all files."""
    pairs = list(zip(paths, messages, strict=True))
    joined: dict[str, Any] = {}
    file_of: dict[str, I64] = {}
    for name, ids in (
        ("vertices", "vertex_ids"),
        ("edges", "edge_ids"),
        ("missions", "mission_ids"),
        ("baseframes", "baseframe_ids"),
    ):
        joined[name] = [entity for m in messages for entity in getattr(m, name)]
        parts = [ids_of(getattr(m, ids), f"{path}: {ids}") for path, m in pairs]
        joined[ids] = np.concatenate(parts)
        file_of[name] = np.repeat(np.arange(len(paths)), [len(part) for part in parts])
    entries = [entry for m in messages for entry in m.landmark_index]
    return Content(
        **joined,
        legacy_landmark_ids=ids_of(
            (i for m in messages for i in m.legacy_landmark_ids), "legacy landmark ids"
        ),
        index_vertex_ids=ids_of((e.vertex_id for e in entries), "landmark_index: vertex_id"),
        index_landmark_ids=ids_of((e.landmark_id for e in entries), "landmark_index: landmark_id"),
        paths=tuple(paths),
        index_path=next((p for p, m in pairs if m.landmark_index), paths[0].parent),
        file_of=file_of,
    )


def _assemble(
    folder: Path, content: Content, repair: bool, budget: MemoryBudget
) -> tuple[VIMap, list[str]]:
    """Convert the messages to tables; vertex rows are sorted by mission, then time."""
    unique_index(content.edge_ids, "edge", content.file_namer("edges"))
    mission_index = unique_index(content.mission_ids, "mission", content.file_namer("missions"))
    baseframe_index = unique_index(
        content.baseframe_ids, "base frame", content.file_namer("baseframes")
    )
    mission = required_rows(
        mission_index,
        ids_of([v.mission_id for v in content.vertices], "mission", content.namer("vertices")),
        "mission",
        content.namer("vertices"),
    )
    kinds = edge_kinds(content)
    in_file = unique_index(content.vertex_ids, "vertex", content.file_namer("vertices"))
    times = _vertex_times(content)
    order = np.lexsort((times, mission))
    vertices = [content.vertices[k] for k in order]
    vertex_table = tables_from_messages.read_vertices(content, order, mission[order], times[order])
    vertex_index = IdIndex(vertex_table.id)
    name = content.namer("vertices", order)
    edges = _edge_tables(content, kinds, vertex_index)
    notes = check_listed_edges(content, kinds, in_file, repair=repair)
    missions = tables_from_messages.read_missions(content, baseframe_index, vertex_index, mission)
    frames = frames_from_messages.read_frames(vertices, name, budget.max_bytes)
    landmarks, observers, frame_index, keypoint_index, owner = frames_from_messages.read_landmarks(
        vertices, name
    )
    landmark_index = unique_index(
        landmarks.id, "landmark", lambda row: name(int(landmarks.vertex[row]))
    )
    frame_start = starts_of_counts(np.bincount(frames.frames.vertex, minlength=len(vertices)))
    frames = _with_current_ids(frames, content)
    listed = _listed_keypoints(frames, frame_start, vertex_index, observers, frame_index)
    keypoint = np.where(
        keypoint_index < listed[1], listed[0] + keypoint_index, -1
    )  # beyond the frame's keypoints: no such observation
    keypoint[listed[0] < 0] = -1
    linked, repairs = frames_from_messages.linked_keypoints(
        frames, landmark_index, (keypoint, owner), repair=repair
    )
    notes += repairs + _check_landmark_index(
        content, landmarks, vertex_table.id, landmark_index, repair
    )
    metadata, unknown = resources_from_messages.read_metadata(folder, budget.max_bytes)
    vi_map = VIMap(
        metadata=metadata,
        missions=missions,
        baseframes=tables_from_messages.read_baseframes(content),
        vertices=vertex_table,
        frames=frames.frames,
        keypoints=frames.keypoints.replace(landmark=linked),
        landmarks=landmarks,
        **edges,
        absolute_poses=tables_from_messages.read_absolute_poses(vertices, name),
        resources=resources_from_messages.read_resources(
            folder, vertices, content, frame_start, budget
        ),
    )
    return vi_map, notes + unknown


def _edge_tables(content: Content, kinds: list[str], vertex_index: IdIndex) -> dict[str, Any]:
    imu_edges, samples = tables_from_messages.read_imu_edges(
        content, _rows_of(kinds, "imu"), vertex_index
    )
    relative = [k for k, kind in enumerate(kinds) if kind in _TRANSFORMATIONS]
    return {
        "imu_edges": imu_edges,
        "imu_samples": samples,
        "transformation_edges": tables_from_messages.read_transformation_edges(
            content,
            relative,
            [_TRANSFORMATIONS[kinds[k]] for k in relative],
            [getattr(content.edges[k], kinds[k]) for k in relative],
            vertex_index,
        ),
        "loop_closure_edges": tables_from_messages.read_loop_closures(
            content, _rows_of(kinds, "loop_closure"), vertex_index
        ),
    }


def _rows_of(kinds: list[str], kind: str) -> list[int]:
    return [k for k, row_kind in enumerate(kinds) if row_kind == kind]


def _vertex_times(content: Content) -> I64:
    """Return the time of every vertex (file order): of its first stamped frame, else of IMU edges."""
    times = np.full(len(content.vertices), np.iinfo(np.int64).min)
    for row, vertex in enumerate(content.vertices):
        stamps = [f.timestamp_ns for f in vertex.nframe.frames if any(f.id.words)]
        if any(stamps):  # a stamp that is missing reads as 0
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
    frames: frames_from_messages.FrameContent, content: Content
) -> frames_from_messages.FrameContent:
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
    frames: frames_from_messages.FrameContent,
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
    times_listed = np.bincount(rows[known], minlength=len(landmarks))
    wrong += int(np.count_nonzero(times_listed == 0))
    if not wrong:
        return []
    if not repair:
        raise MapError(
            f"{content.index_path}: the landmark index disagrees with {wrong} stored landmarks; "
            "load with --repair to use the vertices"
        )
    return [f"{wrong} entries of the landmark index repaired"]
