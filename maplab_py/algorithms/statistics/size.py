"""Memory of a map by kind of data, and possible savings by map maintenance."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from maplab_py.algorithms.keyframing.heuristic import keyframe
from maplab_py.algorithms.keyframing.options import KeyframingOptions
from maplab_py.progress import SILENT, Progress
from maplab_py.report import Report
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.edits import remove_landmarks
from maplab_py.vision.projection import DIMENSIONS

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


@dataclasses.dataclass(frozen=True)
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
        progress: Progress.
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
        remove_landmarks(vi_map, bad),
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
            remove_landmarks(vi_map, removed),
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
