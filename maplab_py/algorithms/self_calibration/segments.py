"""Motion segments: runs of keyframes of a mission, and maps that hold nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maplab_py.estimation.gauge import clusters
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import content_rng
from maplab_py.vimap.ids import random_ids
from maplab_py.vimap.selection import keep_rows
from maplab_py.vimap.table import ragged_rows
from maplab_py.vimap.tables import (
    NO_ROW,
    AbsolutePoses,
    LoopClosureEdges,
    Resources,
    TransformationEdges,
)
from maplab_py.vimap.vertex_removal import move_landmarks, stores_for

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_FAR_M = 10.0
"""Parallax is judged as if no landmark were farther away."""
_USUALLY_WITHIN = 0.9
"""Nor is it judged as if one were nearer than this share of the landmarks seem to be: where there is
little parallax, and where poses have drifted, landmarks are estimated too near and seem to have it."""


def cut(vi_map: VIMap, missions: NDArray[np.integer] | None, keyframes: int) -> list[I64]:
    """Cut missions (rows, None = all) into segments: vertex rows, ascending.

    Neighbours share their boundary vertex, so that segments that are kept side by side stay
    joined by their inertial edges. Segments are not cut across vertices that no inertial edge
    joins; remainders shorter than half a segment are left out.
    """
    has_edge = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    edges = vi_map.imu_edges
    following = (edges.to_vertex == edges.from_vertex + 1) & (edges.sample_count > 1)
    has_edge[edges.from_vertex[following]] = True
    mission = vi_map.vertices.mission
    chosen = np.arange(len(vi_map.missions)) if missions is None else np.asarray(missions)
    segments: list[I64] = []
    stride = max(keyframes - 1, 1)
    for row in chosen.tolist():
        own = np.flatnonzero(mission == row)
        breaks = np.flatnonzero(~has_edge[own[:-1]]) + 1
        for run in np.split(own, breaks):
            for first in range(0, len(run) - 1, stride):
                segment = run[first : first + keyframes]
                if len(segment) > max(keyframes // 2, 1):
                    segments.append(segment)
    return segments


def restricted(vi_map: VIMap, vertices: I64) -> VIMap:
    """Return the map of some vertices: raw IMU between neighbours, tracks, states, calibration.

    Landmarks stay when two of the vertices observe them, at their places in G. Descriptors,
    keypoints of nothing, resources and all other edges go.
    """
    kept = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    kept[vertices] = True
    tracks = _with_tracks_only(vi_map, kept)
    lost = np.flatnonzero(~kept[tracks.landmarks.vertex])
    store = stores_for(tracks, lost, kept, same_mission=False)
    tracks = move_landmarks(tracks, lost, store)
    missions = np.unique(vi_map.vertices.mission[vertices]).astype(np.int64)
    result = keep_rows(tracks, missions=missions, vertices=np.flatnonzero(kept))
    return result.replace(
        transformation_edges=TransformationEdges.empty(),
        loop_closure_edges=LoopClosureEdges.empty(),
        absolute_poses=AbsolutePoses.empty(),
        resources=Resources.empty(),
    )


def _with_tracks_only(vi_map: VIMap, kept: Mask) -> VIMap:
    """Drop keypoints and landmarks that do not join two of the kept vertices."""
    landmark = vi_map.keypoints.landmark
    inside = np.flatnonzero((landmark >= 0) & kept[vi_map.keypoint_vertex])
    pair = landmark[inside].astype(np.int64) * len(vi_map.vertices) + vi_map.keypoint_vertex[inside]
    observers = np.bincount(
        np.unique(pair) // max(len(vi_map.vertices), 1), minlength=len(vi_map.landmarks)
    )
    used = np.flatnonzero(observers >= 2)
    new_row = np.full(len(vi_map.landmarks) + 1, NO_ROW, dtype=np.int32)
    new_row[used] = np.arange(len(used), dtype=np.int32)
    rows = inside[new_row[landmark[inside]] >= 0]
    frames = vi_map.frames
    table = vi_map.keypoints.take(rows)
    return vi_map.replace(
        frames=frames.replace(
            keypoint_count=np.bincount(vi_map.keypoint_frame[rows], minlength=len(frames)),
            descriptor_size=np.zeros(len(frames), dtype=np.int32),
        ),
        keypoints=table.replace(
            landmark=new_row[table.landmark],
            descriptor=np.zeros((len(rows), 0), dtype=np.uint8),
            position_3d=np.zeros((len(rows), 0)),
            time_offset_ns=np.zeros((len(rows), 0), dtype=np.int32),
        ),
        landmarks=vi_map.landmarks.take(used),
    )


def pieces(vi_map: VIMap) -> I64:
    """Label the vertices (V,) by runs that inertial edges join, in row order."""
    edges = vi_map.imu_edges
    links = [(edges.from_vertex.astype(np.int64), edges.to_vertex.astype(np.int64))]
    return clusters(len(vi_map.vertices), links)


def partitions(vi_map: VIMap, min_shared_landmarks: int) -> I64:
    """Label the vertices (V,) by partitions, counted in row order (thesis algorithm 4).

    Vertices that inertial edges join belong together, and so do such runs when they share more
    landmarks than the given number; what grows together counts together.
    """
    label = pieces(vi_map)
    grown: list[set[int]] = []  # runs of each partition
    seen: list[set[int]] = []  # landmarks of each partition
    keypoints = vi_map.observations
    run_of = label[vi_map.keypoint_vertex[keypoints]]
    landmark = vi_map.keypoints.landmark[keypoints]
    for run in range(int(label.max(initial=-1)) + 1):
        runs, own = {run}, set(landmark[run_of == run].tolist())
        joined = [k for k in range(len(seen)) if len(seen[k] & own) > min_shared_landmarks]
        for k in joined:
            runs |= grown[k]
            own |= seen[k]
        grown = [g for k, g in enumerate(grown) if k not in joined] + [runs]
        seen = [s for k, s in enumerate(seen) if k not in joined] + [own]
    partition_of_run = np.zeros(int(label.max(initial=-1)) + 1, dtype=np.int64)
    for number, runs in enumerate(sorted(grown, key=min)):
        partition_of_run[list(runs)] = number
    return np.asarray(partition_of_run[label])


def split_by_partition(vi_map: VIMap, label: I64) -> VIMap:
    """Give every partition its own copy of the landmarks that it shares with others.

    Partitions have separate gauges, so a landmark in two of them would tie what must be free.
    Copies that fewer than two vertices observe are dropped.
    """
    rows = vi_map.observations
    landmark = vi_map.keypoints.landmark[rows].astype(np.int64)
    partition = label[vi_map.keypoint_vertex[rows]]
    count = int(label.max(initial=-1)) + 1
    keys, copy_of = np.unique(landmark * max(count, 1) + partition, return_inverse=True)
    copy_of = np.asarray(copy_of).reshape(-1)
    if len(keys) == len(vi_map.landmarks):
        return vi_map
    first = np.zeros(len(keys), dtype=np.int64)
    first[copy_of[::-1]] = vi_map.keypoint_vertex[rows][::-1]
    source = keys // max(count, 1)
    home = vi_map.landmarks.vertex[source]
    stays = label[home] == keys % max(count, 1)
    table = vi_map.landmarks.take(source)
    new_landmark = np.full(len(vi_map.keypoints), NO_ROW, dtype=np.int32)
    new_landmark[rows] = copy_of
    again = np.flatnonzero(np.concatenate([[False], source[1:] == source[:-1]]))
    ids = table.id.copy()
    ids[again] = random_ids(len(again), content_rng(vi_map, "partitions"))
    copied = vi_map.replace(
        landmarks=table.replace(id=ids),
        keypoints=vi_map.keypoints.replace(landmark=new_landmark),
    )
    moving = np.flatnonzero(~stays)
    copied = move_landmarks(copied, moving, first[moving])
    observers = _observers(copied)
    return keep_rows(copied, landmarks=np.flatnonzero(observers >= 2))


def _observers(vi_map: VIMap) -> I64:
    """Return how many vertices (L,) observe each landmark."""
    rows = vi_map.observations
    pair = vi_map.keypoints.landmark[rows].astype(np.int64) * len(vi_map.vertices)
    unique = np.unique(pair + vi_map.keypoint_vertex[rows])
    return np.bincount(unique // max(len(vi_map.vertices), 1), minlength=len(vi_map.landmarks))


def parallax_rad(vi_map: VIMap) -> F64:
    """Return under which angle (L,) the camera moved as seen from each landmark.

    The motion across the line of sight counts, over the distance or that within which nine tenths
    of the map's landmarks are, whichever is more, but at most `_FAR_M`: distances of landmarks
    without parallax are noise, and mostly too small (decision 109).
    """
    rows = vi_map.observations
    start, landmark = vi_map.observation_start, vi_map.keypoints.landmark[vi_map.observations]
    centre = vi_map.T_G_I[vi_map.keypoint_vertex[rows], 4:]
    count = np.maximum(np.diff(start), 1)
    sums = [np.bincount(landmark, c, minlength=len(count)) for c in centre.T]
    mean = np.stack(sums, axis=1) / count[:, None]
    sight = vi_map.p_G - mean
    depth = np.linalg.norm(sight, axis=1)
    sight /= np.maximum(depth, 1e-9)[:, None]
    offset = centre - mean[landmark]
    along = np.einsum("oi,oi->o", offset, sight[landmark])
    across = np.linalg.norm(offset - along[:, None] * sight[landmark], axis=1)
    widest = np.zeros(len(count))
    np.maximum.at(widest, landmark, across)
    usual = min(float(np.quantile(depth, _USUALLY_WITHIN)), _FAR_M) if len(depth) else _FAR_M
    return np.asarray(2.0 * widest / np.clip(depth, max(usual, 0.1), _FAR_M))


def gap_walks(vi_map: VIMap) -> tuple[I64, I64, F64]:
    """Return the vertices before and after (G,) every gap within a mission, and its length [s].

    Between missions there is none: an IMU that was switched off has new biases.
    """
    label, mission = pieces(vi_map), vi_map.vertices.mission
    before = np.flatnonzero((label[1:] != label[:-1]) & (mission[1:] == mission[:-1]))
    time = vi_map.vertices.timestamp_ns
    return before, before + 1, np.asarray((time[before + 1] - time[before]) * 1e-9)


def tracks_of(vi_map: VIMap, landmarks: I64) -> I64:
    """Return the keypoint rows that observe some landmarks."""
    return np.asarray(vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)])
