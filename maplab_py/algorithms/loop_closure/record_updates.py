"""Write closures and merges into the map's record and read what later searches need."""

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure import closure_record, closure_table, consensus, merging
from maplab_py.algorithms.loop_closure.options import LoopClosureOptions
from maplab_py.algorithms.loop_closure.reports import ClosureRemovalReport, Verdict
from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.vimap import IdArray, IdIndex, LoopClosureEdges, VIMap, edits, to_hex_list
from maplab_py.vimap.table import connected_groups

REMOVED = closure_table.VERDICTS.index(Verdict.REMOVED)
_BAN_REACH_M = 2.0
"""A removed closure bans closures of its query with places within this arc length."""


def banned(vi_map: VIMap, query_vertex: I64, place_vertex: I64) -> Mask:
    """Return which candidates (N,) a user has removed, in either direction."""
    closures = closure_record.read_record(vi_map).closures
    closures = closures.take(closures.verdict == REMOVED)
    result = np.zeros(len(query_vertex), dtype=np.bool_)
    a, b = (vi_map.vertex_index.rows(ids) for ids in (closures.query, closures.place))
    way, mission = consensus.path_lengths(vi_map), vi_map.vertices.mission
    for from_, to in ((a, b), (b, a)):
        order = np.argsort(from_, kind="stable")
        first = np.searchsorted(from_[order], query_vertex, "left")
        last = np.searchsorted(from_[order], query_vertex, "right")
        for step in range(int((last - first).max(initial=0))):
            has = first + step < last
            end = to[order[np.minimum(first + step, len(order) - 1)]]
            near = np.abs(way[end] - way[place_vertex]) <= _BAN_REACH_M
            result |= has & near & (mission[end] == mission[place_vertex])
    return result


def with_closures(
    vi_map: VIMap,
    closures: closure_table.Closures,
    use: str,
    *,
    used: Mask | None = None,
    weight: F64 | None = None,
    merges: merging.MergeResult | None = None,
    before: VIMap | None = None,
) -> VIMap:
    """Write the closures of one search into the map's record.

    Closures that earlier searches used for merges or edges and closures that a user removed stay in
    the record. All other entries are replaced.

    Args:
        vi_map: The map after the search.
        closures: All closures, with rows of the map before the search (vertices are unchanged).
        use: Use of accepted closures, one of USES.
        used: Mask (N,) of closures that were used; None = all accepted ones.
        weight: Weight (N,) of each closure after relaxation.
        merges: Merges that the closures support.
        before: The map before merging.
    """
    old = closure_record.read_record(vi_map)
    new = _closure_rows(vi_map, closures, use, used, weight)
    again = IdIndex(new.id).rows(old.closures.id)
    lasting = np.isin(
        old.closures.use, (closure_record.USES.index("merge"), closure_record.USES.index("edge"))
    )
    use_column = new.use.copy()
    is_known = (again >= 0) & lasting
    use_column[again[is_known]] = old.closures.use[is_known]
    kept = (again < 0) & (lasting | (old.closures.verdict == REMOVED))
    table = closure_record.ClosureRecord.concatenate(
        [old.closures.take(kept), new.replace(use=use_column)]
    )
    record = dataclasses.replace(old, closures=table)
    if merges is not None and before is not None:
        record = _with_merges(record, before, closures, merges)
    return closure_record.write_record(vi_map, record)


def _closure_rows(
    vi_map: VIMap, c: closure_table.Closures, use: str, used: Mask | None, weight: F64 | None
) -> closure_record.ClosureRecord:
    served = c.accepted if used is None else used
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.einsum("nii->ni", c.covariance))
    _, first = np.unique(c.id, axis=0, return_index=True)  # two places may share their vertex
    return closure_record.ClosureRecord.filled(
        len(c),
        id=c.id,
        query=vi_map.vertices.id[c.query_vertex],
        place=vi_map.vertices.id[c.place_vertex],
        T_A_B=c.T_A_B,
        sigma=sigma,
        **{
            field.name: getattr(c, field.name)
            for field in dataclasses.fields(closure_table.GateValues)
        },
        use=np.where(served, closure_record.USES.index(use), 0),
        weight=np.ones(len(c)) if weight is None else weight,
    ).take(np.sort(first))


def _with_merges(
    record: closure_record.LoopRecord,
    before: VIMap,
    closures: closure_table.Closures,
    merges: merging.MergeResult,
) -> closure_record.LoopRecord:
    """Append the pairs, the landmarks before merging, and the keypoints that observed them."""
    lm = before.landmarks
    touched = distinct(np.concatenate([merges.first, merges.second]))
    landmarks = closure_record.MergedLandmarks(
        id=lm.id[touched],
        vertex=before.vertices.id[lm.vertex[touched]],
        p_I=lm.p_I[touched],
        quality=lm.quality[touched],
        feature_type=lm.feature_type[touched],
    )
    keypoint = np.flatnonzero(np.isin(before.keypoints.landmark, touched))
    frame = before.keypoint_frame[keypoint]
    keypoints = closure_record.MergedKeypoints(
        frame=before.frames.id[frame],
        index=keypoint - before.keypoint_start[frame],
        landmark=lm.id[before.keypoints.landmark[keypoint]],
    )
    pairs = closure_record.MergePairs.filled(
        len(merges.closure),
        first=lm.id[merges.first],
        second=lm.id[merges.second],
        closure=closures.id[merges.closure],
        wanted=merges.wanted,
    )
    return dataclasses.replace(
        record,
        landmarks=closure_record.MergedLandmarks.concatenate([record.landmarks, landmarks]),
        keypoints=closure_record.MergedKeypoints.concatenate([record.keypoints, keypoints]),
        pairs=closure_record.MergePairs.concatenate([record.pairs, pairs]),
    )


def remove_closures(vi_map: VIMap, ids: IdArray) -> tuple[VIMap, ClosureRemovalReport]:
    """Remove closures; later searches reject them.

    A merge stays as long as enough other closures support it. If it is undone, the landmarks are
    restored with their positions in the body frames of their vertices and their observations.
    Observations that were removed since then are not restored.

    Args:
        ids: Ids (N, 2) of closures in the record.
    """
    record = closure_record.read_record(vi_map)
    removed = IdIndex(ids).rows(record.closures.id) >= 0
    relaxed = removed & (record.closures.use == closure_record.USES.index("relax"))
    verdict = np.where(removed, REMOVED, record.closures.verdict)
    closures = record.closures.replace(
        verdict=verdict, use=np.where(removed, 0, record.closures.use)
    )
    edges = IdIndex(ids).rows(vi_map.loop_closure_edges.id) >= 0
    result = edits.remove_loop_closure_edges(vi_map, edges) if edges.any() else vi_map
    pairs = record.pairs.take(IdIndex(ids).rows(record.pairs.closure) < 0)
    result, restored, moved, pairs = _restore(result, record, _still_wanted(pairs, record.closures))
    result = closure_record.write_record(
        result, dataclasses.replace(record, closures=closures, pairs=pairs)
    )
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


def accept_closures(vi_map: VIMap, ids: IdArray, options: LoopClosureOptions) -> VIMap:
    """Accept refused closures by hand: each becomes an edge with its recorded pose and uncertainty.

    Args:
        ids: Ids (N, 2) of closures in the record; those that are accepted already stay as they are.

    Raises:
        UserError: The pose of a closure was not determined.
    """
    record = closure_record.read_record(vi_map)
    c = record.closures
    chosen = (IdIndex(ids).rows(c.id) >= 0) & (
        c.verdict != closure_table.VERDICTS.index(Verdict.ACCEPTED)
    )
    new = c.take(chosen)
    unknown = ~np.isfinite(new.sigma).all(axis=1)
    if unknown.any():
        name = to_hex_list(new.id[unknown])[0][:8]
        raise UserError(f"closure {name} has no uncertainty: its pose is not determined, refuse it")
    query, place = (vi_map.vertex_index.rows(v).astype(np.int64) for v in (new.query, new.place))
    T_M_A = se3.compose(vi_map.vertices.T_M_I[place], se3.inverse(new.T_A_B))
    covariance = new.sigma.astype(np.float64)[:, :, None] ** 2 * np.eye(6)
    edges = closure_table.make_edges(new.id, (query, place), T_M_A, new.T_A_B, covariance, options)
    old = vi_map.loop_closure_edges
    kept = old.take(IdIndex(new.id).rows(old.id) < 0)
    closures = c.replace(
        verdict=np.where(chosen, closure_table.VERDICTS.index(Verdict.ACCEPTED), c.verdict),
        use=np.where(chosen, closure_record.USES.index("edge"), c.use),
        weight=np.where(chosen, 1.0, c.weight),
    )
    result = vi_map.replace(loop_closure_edges=LoopClosureEdges.concatenate([kept, edges]))
    return closure_record.write_record(result, dataclasses.replace(record, closures=closures))


def _still_wanted(
    pairs: closure_record.MergePairs, closures: closure_record.ClosureRecord
) -> closure_record.MergePairs:
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


def _groups(landmarks: IdIndex, count: int, pairs: closure_record.MergePairs) -> I64:
    """Label recorded landmarks (count,) by connected component of the pairs."""
    return connected_groups(landmarks.rows(pairs.first), landmarks.rows(pairs.second), count)


def _restore(
    vi_map: VIMap, record: closure_record.LoopRecord, pairs: closure_record.MergePairs
) -> tuple[VIMap, int, int, closure_record.MergePairs]:
    """Split merged landmarks into the groups that the remaining pairs connect."""
    lm = _first_of_each(record.landmarks)
    index = IdIndex(lm.id)
    united = _groups(index, len(lm), record.pairs)  # landmarks that are merged in the map now
    label = _groups(index, len(lm), pairs)
    present = vi_map.landmark_index.rows(lm.id)  # survivors
    vertex = vi_map.vertex_index.rows(lm.vertex)
    # a group without surviving member restores one of its members
    alive = mask_of(len(lm) + 1, label[present >= 0])
    has_survivor = mask_of(len(lm) + 1, united[present >= 0])
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
    result = edits.add_landmarks(
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


def _as_before(
    vi_map: VIMap, recorded: closure_record.MergedLandmarks, rows: I64, vertex: I64
) -> VIMap:
    """Give landmarks that lost all they were merged with their recorded position and quality.

    Args:
        recorded: Landmarks before merging.
        rows: Rows (N,) of these.
        vertex: Vertex rows (N,) that the recorded positions are relative to.
    """
    landmarks = vi_map.landmark_index.rows(recorded.id[rows])
    p_G = se3.transform(vi_map.T_G_I[vertex], recorded.p_I[rows])
    moved = edits.with_p_G(vi_map, landmarks, p_G)
    stored_there = moved.landmarks.vertex[landmarks] == vertex
    p_I = recorded.p_I[rows[stored_there]]
    table = moved.landmarks.put(landmarks[stored_there], p_I=p_I)
    return moved.replace(landmarks=table.put(landmarks, quality=recorded.quality[rows]))


def _first_of_each(landmarks: closure_record.MergedLandmarks) -> closure_record.MergedLandmarks:
    """Return one row per landmark, the oldest."""
    _, first = np.unique(landmarks.id, axis=0, return_index=True)
    return landmarks.take(np.sort(first))


def _recorded_keypoints(
    vi_map: VIMap, record: closure_record.LoopRecord, index: IdIndex
) -> tuple[I64, I64]:
    """Return existing keypoint rows and the recorded original landmark of each."""
    frame = IdIndex(vi_map.frames.id).rows(record.keypoints.frame)
    original = index.rows(record.keypoints.landmark)
    good = (frame >= 0) & (original >= 0)
    good[good] &= record.keypoints.index[good] < vi_map.frames.keypoint_count[frame[good]]
    keypoint = vi_map.keypoint_start[frame[good]] + record.keypoints.index[good]
    keypoint, first = np.unique(keypoint, return_index=True)
    return keypoint, original[good][first]
