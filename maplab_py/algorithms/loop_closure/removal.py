"""Taking back single closures: their edges, and the merges that they alone justified."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.loop_closure.closure_report import RemovalReport
from maplab_py.algorithms.loop_closure.record import (
    USES,
    ClosureRecord,
    LoopRecord,
    MergedLandmarks,
    MergePairs,
    read_record,
    write_record,
)
from maplab_py.algorithms.loop_closure.recording import REMOVED
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import add_landmarks, remove_loop_closure_edges
from maplab_py.vimap.ids import IdArray, IdIndex, to_hex_list

I64 = NDArray[np.int64]


def remove_closures(vi_map: VIMap, ids: IdArray) -> tuple[VIMap, RemovalReport]:
    """Take back closures; later searches refuse them.

    A merge stays as long as enough other closures speak for it. Where it falls, the landmarks are
    again what they were before, each at its old place in the body frame of its vertex, with the
    observations it had (those that have been removed since stay removed).

    Args:
        vi_map: A map with a record.
        ids: Ids (N, 2) of closures in the record.
    """
    record = read_record(vi_map)
    gone = IdIndex(ids).rows(record.closures.id) >= 0
    relaxed = gone & (record.closures.use == USES.index("relax"))
    verdict = np.where(gone, REMOVED, record.closures.verdict)
    closures = record.closures.replace(verdict=verdict, use=np.where(gone, 0, record.closures.use))
    edges = IdIndex(ids).rows(vi_map.loop_closure_edges.id) >= 0
    result = remove_loop_closure_edges(vi_map, edges) if edges.any() else vi_map
    pairs = record.pairs.take(IdIndex(ids).rows(record.pairs.closure) < 0)
    result, restored, moved, pairs = _restored(
        result, record, _still_wanted(pairs, record.closures)
    )
    result = write_record(result, dataclasses.replace(record, closures=closures, pairs=pairs))
    notes = []
    if relaxed.any():
        notes.append("the trajectories stay as relax has bent them: run relax again")
    return result, RemovalReport(
        closures=tuple(name[:8] for name in to_hex_list(record.closures.id[gone])),
        edges_removed=int(np.count_nonzero(edges)),
        landmarks_restored=restored,
        observations_moved=moved,
        notes=tuple(notes),
    )


def _still_wanted(pairs: MergePairs, closures: ClosureRecord) -> MergePairs:
    """Return the pairs that closures of enough query vertices speak for."""
    count = len(pairs)
    if count == 0:
        return pairs
    query = closures.query[IdIndex(closures.id).rows(pairs.closure)]
    ends = np.concatenate([pairs.first, pairs.second])
    _, number = np.unique(ends, axis=0, return_inverse=True)
    both = np.sort(number.reshape(2, count).T, axis=1).astype(np.uint64)
    pair_key, pair = np.unique(both, axis=0, return_inverse=True)
    pair = pair.reshape(-1)
    said = np.column_stack([pair.astype(np.uint64), query])
    votes = np.bincount(np.unique(said, axis=0)[:, 0].astype(np.int64), minlength=len(pair_key))
    return pairs.take(votes[pair] >= pairs.wanted)


def _groups(landmarks: IdIndex, count: int, pairs: MergePairs) -> I64:
    """Label recorded landmarks (count,): those that the pairs unite have the same label."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = landmarks.rows(pairs.first), landmarks.rows(pairs.second)
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _restored(
    vi_map: VIMap, record: LoopRecord, pairs: MergePairs
) -> tuple[VIMap, int, int, MergePairs]:
    """Split united landmarks into what the remaining pairs still unite."""
    lm = _first_of_each(record.landmarks)
    index = IdIndex(lm.id)
    united = _groups(index, len(lm), record.pairs)  # what is one landmark in the map now
    label = _groups(index, len(lm), pairs)
    present = vi_map.landmark_index.rows(lm.id)  # survivors
    vertex = vi_map.vertex_index.rows(lm.vertex)
    # a group that has no survivor among its members gets one of them back
    alive = np.zeros(len(lm) + 1, dtype=np.bool_)
    alive[label[present >= 0]] = True
    has_survivor = np.zeros(len(lm) + 1, dtype=np.bool_)
    has_survivor[united[present >= 0]] = True
    orphan = np.flatnonzero(~alive[label] & (vertex >= 0) & has_survivor[united])
    _, first = np.unique(label[orphan], return_index=True)
    back = orphan[first]
    row_of_label = np.full(len(lm) + 1, -1, dtype=np.int64)
    row_of_label[label[back]] = np.arange(len(back))
    keypoint, original = _recorded_keypoints(vi_map, record, index)
    target = row_of_label[label[original]]
    # only keypoints that observe what their landmark was merged into follow
    now = vi_map.keypoints.landmark[keypoint]
    survivor_group = np.full(len(vi_map.landmarks) + 1, -1, dtype=np.int64)
    survivor_group[present[present >= 0]] = united[present >= 0]
    moves = (target >= 0) & (now >= 0) & (survivor_group[now] == united[original])
    result = add_landmarks(
        vi_map,
        vertex=vertex[back],
        p_I=lm.p_I[back],
        keypoint_rows=keypoint[moves],
        keypoint_landmark=target[moves],
        ids=lm.id[back],
        quality=lm.quality[back],
        feature_type=lm.feature_type[back],
    )
    return result, len(back), int(np.count_nonzero(moves)), pairs


def _first_of_each(landmarks: MergedLandmarks) -> MergedLandmarks:
    """Return one row per landmark, the oldest."""
    _, first = np.unique(landmarks.id, axis=0, return_index=True)
    return landmarks.take(np.sort(first))


def _recorded_keypoints(vi_map: VIMap, record: LoopRecord, index: IdIndex) -> tuple[I64, I64]:
    """Return keypoint rows that are still there, and the recorded landmark each saw at first."""
    frame = IdIndex(vi_map.frames.id).rows(record.keypoints.frame)
    original = index.rows(record.keypoints.landmark)
    good = (frame >= 0) & (original >= 0)
    good[good] &= record.keypoints.index[good] < vi_map.frames.keypoint_count[frame[good]]
    keypoint = vi_map.keypoint_start[frame[good]] + record.keypoints.index[good]
    keypoint, first = np.unique(keypoint, return_index=True)
    return keypoint, original[good][first]
