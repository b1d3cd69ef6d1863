"""Remove single closures with their edges and the merges that only they support."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import (
    USES,
    ClosureRecord,
    LoopRecord,
    MergedLandmarks,
    MergePairs,
    read_record,
    write_record,
)
from maplab_py.algorithms.loop_closure.record_updates import REMOVED
from maplab_py.algorithms.loop_closure.reports import ClosureRemovalReport
from maplab_py.array_types import I64
from maplab_py.geometry import se3
from maplab_py.vimap import VIMap
from maplab_py.vimap.edits import add_landmarks, remove_loop_closure_edges, with_p_G
from maplab_py.vimap.ids import IdArray, IdIndex, to_hex_list


def remove_closures(vi_map: VIMap, ids: IdArray) -> tuple[VIMap, ClosureRemovalReport]:
    """Remove closures; later searches reject them.

    A merge stays as long as enough other closures support it. If it is undone, the landmarks are
    restored with their positions in the body frames of their vertices and their observations.
    Observations that were removed since then are not restored.

    Args:
        vi_map: A map with a record.
        ids: Ids (N, 2) of closures in the record.
    """
    record = read_record(vi_map)
    removed = IdIndex(ids).rows(record.closures.id) >= 0
    relaxed = removed & (record.closures.use == USES.index("relax"))
    verdict = np.where(removed, REMOVED, record.closures.verdict)
    closures = record.closures.replace(
        verdict=verdict, use=np.where(removed, 0, record.closures.use)
    )
    edges = IdIndex(ids).rows(vi_map.loop_closure_edges.id) >= 0
    result = remove_loop_closure_edges(vi_map, edges) if edges.any() else vi_map
    pairs = record.pairs.take(IdIndex(ids).rows(record.pairs.closure) < 0)
    result, restored, moved, pairs = _restore(result, record, _still_wanted(pairs, record.closures))
    result = write_record(result, dataclasses.replace(record, closures=closures, pairs=pairs))
    notes = []
    if relaxed.any():
        notes.append("the trajectories keep their relaxed poses: run relax again")
    return result, ClosureRemovalReport(
        closures=tuple(name[:8] for name in to_hex_list(record.closures.id[removed])),
        edges_removed=int(np.count_nonzero(edges)),
        landmarks_restored=restored,
        observations_moved=moved,
        notes=tuple(notes),
    )


def _still_wanted(pairs: MergePairs, closures: ClosureRecord) -> MergePairs:
    """Return the pairs that closures of enough query vertices support."""
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
    """Label recorded landmarks (count,) by connected component of the pairs."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    a, b = landmarks.rows(pairs.first), landmarks.rows(pairs.second)
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def _restore(
    vi_map: VIMap, record: LoopRecord, pairs: MergePairs
) -> tuple[VIMap, int, int, MergePairs]:
    """Split merged landmarks into the groups that the remaining pairs connect."""
    lm = _first_of_each(record.landmarks)
    index = IdIndex(lm.id)
    united = _groups(index, len(lm), record.pairs)  # landmarks that are merged in the map now
    label = _groups(index, len(lm), pairs)
    present = vi_map.landmark_index.rows(lm.id)  # survivors
    vertex = vi_map.vertex_index.rows(lm.vertex)
    # a group without surviving member restores one of its members
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
    # move only keypoints that observe the landmark which theirs was merged into
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
    is_split = np.bincount(united, minlength=1)[united] > 1
    is_alone = is_split & (np.bincount(label, minlength=1)[label] == 1)
    alone = np.flatnonzero(is_alone & (present >= 0) & (vertex >= 0))
    result = _as_before(result, lm, alone, vertex[alone])
    return result, len(back), int(np.count_nonzero(moves)), pairs


def _as_before(vi_map: VIMap, recorded: MergedLandmarks, rows: I64, vertex: I64) -> VIMap:
    """Give landmarks that lost all they were merged with their recorded position and quality.

    Args:
        vi_map: The map.
        recorded: Landmarks before merging.
        rows: Rows (N,) of these.
        vertex: Vertex rows (N,) that the recorded positions are relative to.
    """
    landmarks = vi_map.landmark_index.rows(recorded.id[rows])
    p_G = se3.transform(vi_map.T_G_I[vertex], recorded.p_I[rows])
    moved = with_p_G(vi_map, landmarks, p_G)
    stored_there = moved.landmarks.vertex[landmarks] == vertex
    p_I, quality = np.array(moved.landmarks.p_I), np.array(moved.landmarks.quality)
    p_I[landmarks[stored_there]] = recorded.p_I[rows[stored_there]]
    quality[landmarks] = recorded.quality[rows]
    return moved.replace(landmarks=moved.landmarks.replace(p_I=p_I, quality=quality))


def _first_of_each(landmarks: MergedLandmarks) -> MergedLandmarks:
    """Return one row per landmark, the oldest."""
    _, first = np.unique(landmarks.id, axis=0, return_index=True)
    return landmarks.take(np.sort(first))


def _recorded_keypoints(vi_map: VIMap, record: LoopRecord, index: IdIndex) -> tuple[I64, I64]:
    """Return existing keypoint rows and the recorded original landmark of each."""
    frame = IdIndex(vi_map.frames.id).rows(record.keypoints.frame)
    original = index.rows(record.keypoints.landmark)
    good = (frame >= 0) & (original >= 0)
    good[good] &= record.keypoints.index[good] < vi_map.frames.keypoint_count[frame[good]]
    keypoint = vi_map.keypoint_start[frame[good]] + record.keypoints.index[good]
    keypoint, first = np.unique(keypoint, return_index=True)
    return keypoint, original[good][first]
