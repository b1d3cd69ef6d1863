"""Keep a subset of a map's entities, in any order, with every reference rewritten."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import I32, I64, mask_of
from maplab_py.vimap.table import ragged_rows, starts_of_counts
from maplab_py.vimap.tables import NO_ROW, ResourceOwner
from maplab_py.vimap.vi_map import VIMap


def as_rows(rows_or_mask: ArrayLike, size: int) -> I64:
    """Return sorted unique row numbers of rows or a boolean mask (size,)."""
    given = np.asarray(rows_or_mask)
    if given.dtype == np.bool_:
        if given.shape != (size,):
            raise ValueError(f"mask of shape {given.shape} for a table of {size} rows")
        return np.asarray(np.flatnonzero(given), dtype=np.int64)
    rows = np.unique(given.astype(np.int64))
    if len(rows) and (rows[0] < 0 or rows[-1] >= size):
        raise ValueError(f"rows {rows[0]} .. {rows[-1]} do not fit a table of {size} rows")
    return rows


def as_mask(rows_or_mask: ArrayLike, size: int) -> NDArray[np.bool_]:
    """Return the boolean mask (size,) of rows or a mask."""
    return mask_of(size, as_rows(rows_or_mask, size))


def renumbering(size: int, kept: NDArray[Any]) -> I32:
    """Return the new row (size + 1,) of every old row, `NO_ROW` for dropped ones.

    The last entry is `NO_ROW`, so that indexing with `NO_ROW` (-1) gives `NO_ROW`.
    """
    new_row = np.full(size + 1, NO_ROW, dtype=np.int32)
    new_row[kept] = np.arange(len(kept), dtype=np.int32)
    return new_row


def keep_rows(
    vi_map: VIMap,
    *,
    missions: I64 | None = None,
    vertices: I64 | None = None,
    landmarks: I64 | None = None,
) -> VIMap:
    """Return the map of the given rows, in the given order; None keeps a table as it is.

    Rows that depend on a dropped row are dropped too: vertices, base frames and resources of missions;
    frames, keypoints, edges, absolute poses and stored landmarks of vertices; observations of
    landmarks. Rows of `vertices` must already respect the order that the table wants.
    """
    if missions is not None:
        vi_map = _keep_missions(vi_map, missions)
        if vertices is None:
            vertices = np.flatnonzero(vi_map.vertices.mission >= 0)
    if vertices is not None:
        vi_map = _keep_vertices(vi_map, vertices)
        if landmarks is None:
            landmarks = np.flatnonzero(vi_map.landmarks.vertex >= 0)
        else:
            landmarks = landmarks[vi_map.landmarks.vertex[landmarks] >= 0]
    if landmarks is not None and not _is_identity(landmarks, len(vi_map.landmarks)):
        new_landmark = renumbering(len(vi_map.landmarks), landmarks)
        keypoints = vi_map.keypoints
        vi_map = vi_map.replace(
            landmarks=vi_map.landmarks.take(landmarks),
            keypoints=keypoints.replace(landmark=new_landmark[keypoints.landmark]),
        )
    return vi_map


def sorted_by_time(vi_map: VIMap) -> VIMap:
    """Re-establish the order of the tables: vertices by mission and time, frames and edges by vertex."""
    v = vi_map.vertices
    return keep_rows(vi_map, vertices=np.lexsort((v.timestamp_ns, v.mission)))


def _is_identity(rows: I64, size: int) -> bool:
    return len(rows) == size and bool(np.array_equal(rows, np.arange(size)))


def _keep_missions(vi_map: VIMap, missions: I64) -> VIMap:
    new_mission = renumbering(len(vi_map.missions), missions)
    kept_baseframes = np.unique(vi_map.missions.baseframe[missions])
    kept_baseframes = kept_baseframes[kept_baseframes >= 0].astype(np.int64)
    new_baseframe = renumbering(len(vi_map.baseframes), kept_baseframes)
    table = vi_map.missions.take(missions)
    resources = vi_map.resources
    by_mission = np.isin(resources.owner_kind, (ResourceOwner.MISSION, ResourceOwner.SENSOR))
    owner = np.where(
        by_mission, new_mission[np.where(by_mission, resources.owner, -1)], resources.owner
    )
    resources = resources.replace(owner=owner).take(~by_mission | (owner >= 0))
    mission = new_mission[vi_map.vertices.mission]
    return vi_map.replace(
        missions=table.replace(baseframe=new_baseframe[table.baseframe]),
        baseframes=vi_map.baseframes.take(kept_baseframes),
        vertices=vi_map.vertices.replace(mission=mission),
        resources=resources,
    )


def _keep_vertices(vi_map: VIMap, vertices: I64) -> VIMap:
    new_vertex = renumbering(len(vi_map.vertices), vertices)
    vi_map = _keep_frames(vi_map, new_vertex)
    missions = vi_map.missions
    table = vi_map.vertices.take(vertices)
    absolute = vi_map.absolute_poses
    absolute = absolute.replace(vertex=new_vertex[absolute.vertex])
    parts: dict[str, object] = {}
    for name in ("transformation_edges", "loop_closure_edges"):
        edges = getattr(vi_map, name)
        edges = edges.replace(
            from_vertex=new_vertex[edges.from_vertex], to_vertex=new_vertex[edges.to_vertex]
        )
        parts[name] = edges.take((edges.from_vertex >= 0) & (edges.to_vertex >= 0))
    imu = vi_map.imu_edges
    imu = imu.replace(from_vertex=new_vertex[imu.from_vertex], to_vertex=new_vertex[imu.to_vertex])
    kept = np.flatnonzero((imu.from_vertex >= 0) & (imu.to_vertex >= 0))
    kept = kept[np.argsort(imu.from_vertex[kept], kind="stable")]
    if not _is_identity(kept, len(imu)):
        parts["imu_samples"] = vi_map.imu_samples.take(ragged_rows(vi_map.sample_start, kept))
    start = starts_of_counts(np.bincount(table.mission, minlength=len(missions)))
    return vi_map.replace(
        missions=missions.replace(
            root_vertex=np.where(np.diff(start) > 0, start[:-1], NO_ROW).astype(np.int32)
        ),
        vertices=table,
        landmarks=vi_map.landmarks.replace(vertex=new_vertex[vi_map.landmarks.vertex]),
        absolute_poses=absolute.take(absolute.vertex >= 0),
        imu_edges=imu.take(kept),
        **parts,
    )


def _keep_frames(vi_map: VIMap, new_vertex: I32) -> VIMap:
    """Rewrite the frames' vertices, drop frames without one, and sort by vertex and camera."""
    frames = vi_map.frames
    vertex = new_vertex[frames.vertex]
    order = np.lexsort((frames.camera_index, vertex))
    kept = order[vertex[order] >= 0]
    table = frames.replace(vertex=vertex)
    if _is_identity(kept, len(frames)):
        return vi_map.replace(frames=table)
    new_frame = renumbering(len(frames), kept)
    resources = vi_map.resources
    by_frame = resources.owner_kind == ResourceOwner.FRAME
    owner = np.where(by_frame, new_frame[np.where(by_frame, resources.owner, -1)], resources.owner)
    return vi_map.replace(
        frames=table.take(kept),
        keypoints=vi_map.keypoints.take(ragged_rows(vi_map.keypoint_start, kept)),
        resources=resources.replace(owner=owner).take(~by_frame | (owner >= 0)),
    )
