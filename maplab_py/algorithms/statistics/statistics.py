"""Statistics of maps: distributions, and the sizes of their parts."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.geometry.triangulation import largest_ray_angle
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap, edits, observation_counts, observer_counts
from maplab_py.vision.projection import DIMENSIONS


@dataclasses.dataclass(frozen=True)
class QuantityLine:
    """Order statistics of one quantity."""

    quantity: str
    count: int
    least: float
    median: float
    mean: float
    percentile_95: float
    largest: float


class MapDistributions(Report):
    """Order statistics of the quantities that distinguish good maps from bad ones."""

    quantities: tuple[QuantityLine, ...]


def map_distributions(vi_map: VIMap) -> MapDistributions:
    """Return the distributions of the quantities that the map has."""
    v = vi_map.vertices
    inside = v.mission[1:] == v.mission[:-1]
    step_m = np.linalg.norm(np.diff(v.T_M_I[:, 4:], axis=0), axis=1)[inside]
    step_s = (np.diff(v.timestamp_ns) * 1e-9)[inside]
    seeing = vi_map.keypoint_frame[vi_map.keypoints.landmark >= 0]
    landmarks_per_frame = np.bincount(seeing, minlength=len(vi_map.frames))
    tracks = vi_map.keypoints.track_id
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows]
    offset = vi_map.p_G[landmark] - vi_map.T_G_I[vi_map.keypoint_vertex[rows], 4:]
    distance = np.linalg.norm(offset, axis=1)
    seen = np.diff(vi_map.observation_start) >= 2
    rays = np.where(distance[:, None] > 1e-9, offset, np.array([0.0, 0.0, 1.0]))
    angle = np.degrees(largest_ray_angle(rays, vi_map.observation_start))[seen]
    sampled = vi_map.imu_samples.timestamp_ns
    edge_of_sample = np.repeat(np.arange(len(vi_map.imu_edges)), vi_map.imu_edges.sample_count)
    spacing_s = (np.diff(sampled) * 1e-9)[edge_of_sample[1:] == edge_of_sample[:-1]]
    speed = np.linalg.norm(v.v_M, axis=1)
    by_mission = np.bincount(v.mission, minlength=len(vi_map.missions))
    quantities: dict[str, ArrayLike] = {
        "vertices per mission": by_mission,
        "distance of vertices [m]": step_m,
        "time between vertices [s]": step_s,
        "speed [m/s]": speed,
        "keypoints per image": vi_map.frames.keypoint_count,
        "landmarks per image": landmarks_per_frame,
        "keypoints per track": _track_lengths(vi_map) if (tracks >= 0).any() else [],
        "observations per landmark": observation_counts(vi_map),
        "observing vertices per landmark": observer_counts(vi_map),
        "distance of observed landmarks [m]": distance,
        "angle between rays of a landmark [deg]": angle,
        "IMU sample spacing [s]": spacing_s,
        "IMU samples per edge": vi_map.imu_edges.sample_count,
    }
    lines = [_line(name, values) for name, values in quantities.items()]
    return MapDistributions(tuple(line for line in lines if line is not None))


def _track_lengths(vi_map: VIMap) -> ArrayLike:
    """Return the number of keypoints of every track of a camera of a mission."""
    rows = np.flatnonzero(vi_map.keypoints.track_id >= 0)
    frame = vi_map.keypoint_frame[rows]
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
    camera = vi_map.frames.camera_index[frame]
    order = np.lexsort((vi_map.keypoints.track_id[rows], camera, mission))
    keys = np.stack([mission, camera, vi_map.keypoints.track_id[rows]])[:, order]
    first = np.flatnonzero(np.any(np.diff(keys, prepend=-1), axis=0))
    return np.diff(np.append(first, len(rows)))


def _line(name: str, values: ArrayLike) -> QuantityLine | None:
    numbers = np.asarray(values, dtype=np.float64)
    if len(numbers) == 0:
        return None
    return QuantityLine(
        name,
        len(numbers),
        float(numbers.min()),
        float(np.median(numbers)),
        float(numbers.mean()),
        float(np.percentile(numbers, 95.0)),
        float(numbers.max()),
    )


_SPARSE_SHARE = 0.1
_BYTES_PER_OBSERVATION = 4 * DIMENSIONS + 2 * 4
"""Bytes of an observation in a summary map before compression."""
_BYTES_PER_POINT = 3 * 4


@dataclasses.dataclass(frozen=True)
class SizeOfKind:
    """Bytes of one kind of data."""

    kind: str
    rows: int
    megabytes: float
    share: float  # of all


@dataclasses.dataclass(frozen=True)
class Saving:
    """Size of the map after a command."""

    command: str
    megabytes: float
    saved: float = dataclasses.field(metadata={"title": "saved share"})  # of the current size
    what: str = dataclasses.field(metadata={"title": "result"})


class MapSize(Report):
    """Size of a map in memory and on disk, and possible savings."""

    megabytes_in_memory: float = dataclasses.field(metadata={"title": "in memory", "unit": "MB"})
    megabytes_on_disk: float | None = dataclasses.field(  # without resources; None without a folder
        metadata={"title": "on disk", "unit": "MB"}
    )
    megabytes_of_resources: float | None = dataclasses.field(
        metadata={"title": "resources", "unit": "MB"}
    )
    kinds: tuple[SizeOfKind, ...]
    savings: tuple[Saving, ...]


def map_size(
    vi_map: VIMap,
    *,
    folder: Path | None = None,
    keyframing: KeyframingOptions | None = None,
    progress: Progress = SILENT,
) -> MapSize:
    """Measure the size of a map and the savings by map maintenance.

    Args:
        vi_map: The map; it is not changed.
        folder: Where it is on disk.
        keyframing: Options of the keyframing that is tried.
    """
    kinds = bytes_by_kind(vi_map)
    total = max(sum(size for _, size in kinds.values()), 1)
    disk = resources = None
    if folder is not None and folder.is_dir():
        files = [path for path in folder.rglob("*") if path.is_file()]
        inside = [path.relative_to(folder).parts[0] == "resources" for path in files]
        sizes = [path.stat().st_size * 1e-6 for path in files]
        resources = float(
            sum(s for s, is_internal in zip(sizes, inside, strict=True) if is_internal)
        )
        disk = float(sum(sizes)) - resources
    return MapSize(
        megabytes_in_memory=total * 1e-6,
        megabytes_on_disk=disk,
        megabytes_of_resources=resources,
        kinds=tuple(
            SizeOfKind(name, rows, size * 1e-6, size / total)
            for name, (rows, size) in kinds.items()
        ),
        savings=_savings(vi_map, total, keyframing or KeyframingOptions(), progress),
    )


def bytes_by_kind(vi_map: VIMap) -> dict[str, tuple[int, int]]:
    """Return rows and bytes by kind of data."""
    keypoints = vi_map.keypoints
    return {
        "descriptors": (len(keypoints), keypoints.descriptor.nbytes),
        "keypoints": (len(keypoints), _bytes(keypoints) - keypoints.descriptor.nbytes),
        "landmarks": (len(vi_map.landmarks), _bytes(vi_map.landmarks)),
        "IMU samples": (len(vi_map.imu_samples), _bytes(vi_map.imu_samples)),
        "vertices": (len(vi_map.vertices), _bytes(vi_map.vertices)),
        "images": (len(vi_map.frames), _bytes(vi_map.frames)),
        "edges": (
            len(vi_map.imu_edges)
            + len(vi_map.transformation_edges)
            + len(vi_map.loop_closure_edges),
            _bytes(vi_map.imu_edges)
            + _bytes(vi_map.transformation_edges)
            + _bytes(vi_map.loop_closure_edges),
        ),
        "resource references": (len(vi_map.resources), _bytes(vi_map.resources)),
        "absolute poses": (len(vi_map.absolute_poses), _bytes(vi_map.absolute_poses)),
    }


def _savings(
    vi_map: VIMap, total: int, options: KeyframingOptions, progress: Progress
) -> tuple[Saving, ...]:
    lines = []

    def tried(command: str, result: VIMap, what: str) -> None:
        size = sum(size for _, size in bytes_by_kind(result).values())
        lines.append(Saving(command, size * 1e-6, 1.0 - size / total, what))

    if len(vi_map.vertices):
        progress.step(0, 3, "keyframing")
        thin, report = keyframe(vi_map, options)
        tried(
            "keyframe_heuristic",
            thin,
            f"{report.vertices_after} of {len(vi_map.vertices)} vertices stay",
        )
    bad = vi_map.landmarks.quality == LandmarkQuality.BAD
    tried(
        "remove_bad_landmarks",
        edits.remove_landmarks(vi_map, bad),
        f"{int(bad.sum())} landmarks are removed",
    )
    progress.step(1, 3, "sparsification")
    good = np.flatnonzero(vi_map.landmarks.quality == LandmarkQuality.GOOD)
    keep = round(_SPARSE_SHARE * len(good))
    if keep:
        observed = np.diff(vi_map.observation_start)[good]
        removed = np.ones(len(vi_map.landmarks), dtype=np.bool_)
        removed[good[np.argsort(-observed, kind="stable")[:keep]]] = False
        what = f"{keep} landmarks, a tenth of the good ones, stay; their keypoints stay in any case"
        tried(
            f"landmark_sparsify --num_landmarks_to_keep={keep}",
            edits.remove_landmarks(vi_map, removed),
            what,
        )
    progress.step(2, 3, "summary map")
    if len(good):
        is_good = np.append(vi_map.landmarks.quality == LandmarkQuality.GOOD, False)
        described = is_good[vi_map.keypoints.landmark] & (vi_map.binary_descriptor_size > 0)
        observations = int(np.count_nonzero(described))
        size = observations * _BYTES_PER_OBSERVATION
        size += (len(good) + len(vi_map.vertices)) * _BYTES_PER_POINT
        what = f"{len(good)} landmarks, {observations} observations, before compression"
        lines.append(
            Saving("generate_summary_map_and_save_to_disk", size * 1e-6, 1.0 - size / total, what)
        )
    return tuple(lines)


def _bytes(table: Any) -> int:
    return sum(
        column.nbytes
        for column in (getattr(table, field.name) for field in dataclasses.fields(table))
        if isinstance(column, np.ndarray)
    )
