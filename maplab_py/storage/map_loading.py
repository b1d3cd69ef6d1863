"""Load a native map folder and convert its messages to a VI-map."""

import contextlib
import dataclasses
import time
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.array_types import I64, NDArray
from maplab_py.atomic import recover
from maplab_py.errors import MapError
from maplab_py.memory import collection_paused
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.sensors.sensors_yaml import read_sensors
from maplab_py.storage import checksums, file_assembly, load_checks, reading_processes
from maplab_py.storage.cache.map_cache import CachedMap
from maplab_py.storage.mission_names import with_names
from maplab_py.storage.protobuf import (
    frames_from_messages,
    map_files,
    message_numbers,
    resources_from_messages,
    tables_from_messages,
)
from maplab_py.storage.protobuf.ids import ids_of
from maplab_py.storage.protobuf.scan import MemoryBudget
from maplab_py.storage.protobuf.tables_from_messages import Content, required_rows, unique_index
from maplab_py.storage.protobuf.vertex_parts import NO_TIME, JoinedParts, VertexPart
from maplab_py.vimap import IdIndex, VIMap, is_valid, starts_of_counts, to_hex
from maplab_py.vimap.number_repair import without_bad_numbers
from maplab_py.vimap.tables import Frames


class LoadReport(Report):
    """Result of loading a map."""

    folder: str
    files: int
    megabytes: float  # unpacked
    missions: int
    vertices: int
    landmarks: int
    keypoints: int
    notes: list[str]
    seconds: float
    cache: str = ""  # "read" or "written" where the cache of maps was used


def load_map(
    folder: Path,
    *,
    max_size_megabytes: int = 2000,
    repair: bool = False,
    progress: Progress = SILENT,
    listed: str = "",
) -> tuple[VIMap, LoadReport]:
    """Load a map and check that it is consistent.

    Args:
        max_size_megabytes: Bound of the unpacked size of one file.
        repair: Where the two copies of an observation disagree, keep what both say, and drop what is no
            number.
        listed: Checksums of its files (`checksums.listing`) if they are known already.

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
        with collection_paused():
            vi_map, files, total, notes = _load(folder, budget, repair, progress, listed)
    except MapError as error:
        text = str(error)
        raise error if str(folder) in text else MapError(f"{folder}: {text}") from error
    except OSError as error:
        raise MapError(f"{folder}: cannot be read ({error.strerror})") from error
    except MemoryError as error:
        raise MapError(
            f"{folder}: does not fit into memory; end other programs or load parts of it"
        ) from error
    report = _report(folder, vi_map, files, total / 1e6, notes, began)
    return vi_map, report


def facts_of(report: LoadReport) -> dict[str, Any]:
    """Return what the cache has to keep beside the columns, so that a load from there says the same."""
    return {"files": report.files, "megabytes": report.megabytes, "notes": report.notes}


def with_small_files(
    folder: Path, cached: CachedMap, listed: str, max_size_megabytes: int, began: float
) -> tuple[VIMap, LoadReport]:
    """Return a map from the cache with what its small files say: sensors, metadata, names.

    Args:
        cached: Columns from the cache.
        listed: Checksums of the map's files.
        max_size_megabytes: Bound of the size of one file.
        began: When loading began (`time.perf_counter`).

    Raises:
        MapError: A file is damaged.
    """
    max_bytes = max_size_megabytes * 1_000_000
    checksums.verify(folder, listed)
    metadata, _ = resources_from_messages.read_metadata(folder, max_bytes)
    sensors = read_sensors(folder / map_files.VI_MAP_FOLDER / map_files.SENSORS, max_bytes)
    vi_map = with_names(cached.vi_map.replace(sensors=sensors, metadata=metadata), folder)
    facts = cached.facts
    report = _report(folder, vi_map, facts["files"], facts["megabytes"], facts["notes"], began)
    return vi_map, dataclasses.replace(report, cache="read")


def _report(
    folder: Path, vi_map: VIMap, files: int, megabytes: float, notes: list[str], began: float
) -> LoadReport:
    return LoadReport(
        folder=str(folder),
        files=files,
        megabytes=megabytes,
        missions=len(vi_map.missions),
        vertices=len(vi_map.vertices),
        landmarks=len(vi_map.landmarks),
        keypoints=len(vi_map.keypoints),
        notes=notes,
        seconds=time.perf_counter() - began,
    )


def _load(
    folder: Path, budget: MemoryBudget, repair: bool, progress: Progress, listed: str
) -> tuple[VIMap, int, int, list[str]]:
    """Return the map, the number of its files and their unpacked bytes, and notes."""
    files = map_files.listed_files(folder, budget.max_bytes)
    checksums.verify(folder, listed)
    sensors_file = folder / map_files.VI_MAP_FOLDER / map_files.SENSORS
    with message_numbers.accept_bad_numbers() if repair else contextlib.nullcontext():
        parts = _read_files(files, budget, progress, in_processes=not repair)
        load_checks.check_empty_files(parts.facts)
        sensors = read_sensors(sensors_file, budget.max_bytes)
        content = parts.content()
        load_checks.check_records(content, budget.max_bytes)
        vi_map, notes = _assemble(folder, content, parts.vertices, repair, budget)
        vi_map = with_names(vi_map.replace(sensors=sensors), folder)
        if repair:
            vi_map, dropped = without_bad_numbers(vi_map)
            notes += dropped
        notes += load_checks.absent_parts(folder, vi_map) + load_checks.consistency_notes(vi_map)
    progress.step(1, 1, "read files")
    return vi_map, len(files), parts.unpacked_bytes, notes


def _read_files(
    files: Sequence[tuple[map_files.FileKind, Path]],
    budget: MemoryBudget,
    progress: Progress,
    *,
    in_processes: bool,
) -> file_assembly.FileParts:
    """Read all files; those of vertices in other processes where that saves time."""
    parts = file_assembly.FileParts()
    with reading_processes.parts_ahead(files if in_processes else []) as ahead:
        if ahead is not None:
            ahead.start(budget)
            files = sorted(
                files, key=lambda file: file[0] is map_files.FileKind.VERTICES
            )  # others meanwhile
        here = [
            path for kind, path in files if ahead is None or kind is not map_files.FileKind.VERTICES
        ]
        with contextlib.closing(_read_ahead(here, budget.max_bytes)) as contents:
            for index, (kind, path) in enumerate(files):
                progress.step(index, len(files) + 1, "read files")
                if ahead is None or kind is not map_files.FileKind.VERTICES:
                    parts.read(kind, path, next(contents), budget)
                    continue
                part = ahead.take(path)
                if part is None:
                    parts.read(kind, path, map_files.read_unpacked(path, budget.max_bytes), budget)
                    continue
                budget.keep(path, sum(vertices.nbytes() for vertices in part.vertices))
                parts.add(part)
    return parts


def _assemble(
    folder: Path, content: Content, parts: list[VertexPart], repair: bool, budget: MemoryBudget
) -> tuple[VIMap, list[str]]:
    """Convert the messages to tables; vertex rows are sorted by mission, then time."""
    unique_index(content.edge_ids, "edge", content.file_namer("edges"))
    mission_index = unique_index(content.mission_ids, "mission", content.file_namer("missions"))
    baseframe_index = unique_index(
        content.baseframe_ids, "base frame", content.file_namer("baseframes")
    )
    mission = required_rows(
        mission_index,
        content.vertex_mission_ids,
        "mission",
        content.namer("vertices"),
    )
    kinds = load_checks.edge_kinds(content)
    in_file = unique_index(content.vertex_ids, "vertex", content.file_namer("vertices"))
    times = _vertex_times(content, parts)
    order = np.lexsort((times, mission))
    joined = JoinedParts(parts, order)
    vertex_table = joined.vertices().replace(mission=mission[order], timestamp_ns=times[order])
    vertex_index = IdIndex(vertex_table.id)
    name = content.namer("vertices", order)
    edges = _edge_tables(content, kinds, vertex_index)
    notes = load_checks.check_listed_edges(content, kinds, in_file, repair=repair)
    missions = tables_from_messages.read_missions(content, baseframe_index, vertex_index, mission)
    frames = joined.frames(budget.max_bytes)
    frames = dataclasses.replace(frames, name=_frame_namer(frames.frames, name))
    landmarks, listed = joined.landmarks()
    landmark_index = unique_index(
        landmarks.id, "landmark", lambda row: name(int(landmarks.vertex[row]))
    )
    frames = _with_current_ids(frames, content)
    keypoint = _listed_keypoints(frames, len(vertex_table), vertex_index, listed)
    linked, repairs = frames_from_messages.linked_keypoints(
        frames, landmark_index, (keypoint, listed.owner), repair=repair
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
        absolute_poses=joined.absolute_poses(),
        resources=resources_from_messages.read_resources(
            folder, joined.resources_of_frames(), content, budget
        ),
    )
    return vi_map, notes + unknown


def _edge_tables(content: Content, kinds: list[str], vertex_index: IdIndex) -> dict[str, Any]:
    imu_edges, samples = tables_from_messages.read_imu_edges(
        content, _rows_of(kinds, "imu"), vertex_index
    )
    return {
        "imu_edges": imu_edges,
        "imu_samples": samples,
        "transformation_edges": tables_from_messages.read_transformation_edges(
            content, kinds, vertex_index
        ),
        "loop_closure_edges": tables_from_messages.read_loop_closures(
            content, _rows_of(kinds, "loop_closure"), vertex_index
        ),
    }


def _rows_of(kinds: list[str], kind: str) -> list[int]:
    return [k for k, row_kind in enumerate(kinds) if row_kind == kind]


def _frame_namer(frames: Frames, vertex_name: message_numbers.Name) -> message_numbers.Name:
    return lambda row: f"{vertex_name(int(frames.vertex[row]))}: frame {to_hex(frames.id[row])}"


def _vertex_times(content: Content, parts: list[VertexPart]) -> I64:
    """Return the time of every vertex (file order): of its first stamped frame, else of IMU edges."""
    stamps = [part.timestamp_ns() for part in parts]
    times = np.concatenate(stamps) if stamps else np.zeros(0, dtype=np.int64)
    unset = np.flatnonzero(times == NO_TIME)
    if len(unset):
        index = IdIndex(content.vertex_ids)
        for edge in content.edges:
            if edge.HasField("imu") and len(edge.imu.timestamps_ns):
                ends = ids_of([edge.imu.from_vertex_id, edge.imu.to_vertex_id], "ends of an edge")
                for row, stamp in zip(
                    index.rows(ends), (edge.imu.timestamps_ns[0], edge.imu.timestamps_ns[-1]),
                    strict=True,
                ):  # fmt: skip
                    if row >= 0 and times[row] == NO_TIME:
                        times[row] = stamp
        times[times == NO_TIME] = 0
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
    vertices: int,
    vertex_index: IdIndex,
    listed: frames_from_messages.ListedObservations,
) -> I64:
    """Return the keypoint row (O,) of each listed observation, -1 where there is none."""
    counts = frames.frames.keypoint_count
    vertex = vertex_index.rows(listed.observers)
    if not len(counts):
        return np.full(len(vertex), -1)
    frame_start = starts_of_counts(np.bincount(frames.frames.vertex, minlength=vertices))
    safe = np.maximum(vertex, 0)
    exists = (vertex >= 0) & (listed.frame_index < frame_start[safe + 1] - frame_start[safe])
    frame = np.where(exists, frame_start[safe] + listed.frame_index, 0)
    exists &= listed.keypoint_index < counts[frame]  # else beyond the frame's keypoints
    return np.where(exists, starts_of_counts(counts)[frame] + listed.keypoint_index, -1)


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


def _read_ahead(paths: Sequence[Path], max_bytes: int) -> Generator[bytes | bytearray, None, None]:
    """Yield the unpacked contents of files; another thread reads one ahead.

    Reading and unpacking release Python's lock, so they take place beside the conversion. With more
    files ahead there would only be more bytes in memory.

    Raises:
        MapError: A file cannot be read, or unpacks to more than the bound; see `read_unpacked`.
        MemoryError: A file, or the thread that reads it, does not fit into memory.
    """
    waiting: Future[bytes | bytearray] | None = None
    with ThreadPoolExecutor(1) as pool:
        for path in paths:
            last = waiting
            try:
                waiting = pool.submit(map_files.read_unpacked, path, max_bytes)
            except RuntimeError as error:  # there is no space for the stack of the thread
                raise MemoryError(str(error)) from error
            if last is not None:
                yield last.result()
        if waiting is not None:
            yield waiting.result()
