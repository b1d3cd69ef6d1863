"""Splitting missions into motion segments, and maps that contain only some keyframes."""

import numpy as np
from numpy.typing import NDArray

from maplab_py.array_types import I64, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.vimap import VIMap, descriptors, selection, tables, vertex_removal


def split_into_segments(
    vi_map: VIMap, missions: NDArray[np.integer] | None, keyframes: int
) -> list[I64]:
    """Split missions (rows, None = all) into segments: vertex rows, ascending.

    Neighbours share their boundary vertex, so that adjacent segments stay joined by inertial edges
    when both are selected. A segment does not span vertices that no inertial edge joins; remainders
    of at most half a segment are dropped.
    """
    has_edge = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    edges = vi_map.imu_edges
    is_next = (edges.to_vertex == edges.from_vertex + 1) & (edges.sample_count > 1)
    has_edge[edges.from_vertex[is_next]] = True
    chosen = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    segments: list[I64] = []
    for mission in chosen.tolist():
        vertices = np.flatnonzero(vi_map.vertices.mission == mission)
        breaks = np.flatnonzero(~has_edge[vertices[:-1]]) + 1
        for run in np.split(vertices, breaks):
            for first in range(0, len(run) - 1, max(keyframes - 1, 1)):
                segment = run[first : first + keyframes]
                if len(segment) > max(keyframes // 2, 1):
                    segments.append(segment)
    return segments


def extract_submap(vi_map: VIMap, vertices: I64) -> VIMap:
    """Return the map of some vertices: inertial edges between neighbours, tracks, states, sensors.

    Landmarks that two of the vertices observe keep their positions in G. Descriptors, keypoints
    without a landmark, resources and all other edges are dropped.
    """
    is_kept = mask_of(len(vi_map.vertices), vertices)
    tracks = _with_tracks_only(vi_map, is_kept)
    moved = np.flatnonzero(~is_kept[tracks.landmarks.vertex])
    store = vertex_removal.stores_for(tracks, moved, is_kept, same_mission=False)
    tracks = vertex_removal.move_landmarks(tracks, moved, store)
    missions = np.unique(vi_map.vertices.mission[vertices]).astype(np.int64)
    result = selection.keep_rows(tracks, missions=missions, vertices=np.flatnonzero(is_kept))
    return result.replace(
        transformation_edges=tables.TransformationEdges.empty(),
        loop_closure_edges=tables.LoopClosureEdges.empty(),
        absolute_poses=tables.AbsolutePoses.empty(),
        resources=tables.Resources.empty(),
    )


def _with_tracks_only(vi_map: VIMap, is_kept: Mask) -> VIMap:
    """Drop keypoints and landmarks that do not join two of the kept vertices."""
    landmark = vi_map.keypoints.landmark
    inside = np.flatnonzero((landmark >= 0) & is_kept[vi_map.keypoint_vertex])
    pair = landmark[inside].astype(np.int64) * len(vi_map.vertices) + vi_map.keypoint_vertex[inside]
    observers = np.bincount(
        distinct(pair) // max(len(vi_map.vertices), 1), minlength=len(vi_map.landmarks)
    )
    used = np.flatnonzero(observers >= 2)
    new_row = selection.renumbering(len(vi_map.landmarks), used)
    rows = inside[new_row[landmark[inside]] >= 0]
    frames, table = vi_map.frames, vi_map.keypoints.take(rows)
    return vi_map.replace(
        frames=frames.replace(
            keypoint_count=np.bincount(vi_map.keypoint_frame[rows], minlength=len(frames)),
            descriptor_blocks=descriptors.no_blocks(len(frames)),
        ),
        keypoints=table.replace(
            landmark=new_row[table.landmark],
            descriptor=np.zeros((len(rows), 0), dtype=np.uint8),
            position_3d=np.zeros((len(rows), 0)),
            time_offset_ns=np.zeros((len(rows), 0), dtype=np.int32),
        ),
        landmarks=vi_map.landmarks.take(used),
    )
