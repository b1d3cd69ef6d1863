"""Write closures and merges into the map's record and read what later searches need."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.loop_closure.closure_record import (
    USES,
    ClosureRecord,
    LoopRecord,
    MergedKeypoints,
    MergedLandmarks,
    MergePairs,
    read_record,
    write_record,
)
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS, Closures
from maplab_py.algorithms.loop_closure.consensus import path_lengths
from maplab_py.algorithms.loop_closure.merging import MergeResult
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.distinct import distinct
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import IdArray, IdIndex

REMOVED = VERDICTS.index(Verdict.REMOVED)
_BAN_REACH_M = 2.0
"""A removed closure bans closures of its query with places within this arc length."""


def closure_ids(vi_map: VIMap, query_vertex: I64, place_vertex: I64) -> IdArray:
    """Return ids (N, 2) derived from the two vertices: the same closure has the same id."""
    q, p = vi_map.vertices.id[query_vertex], vi_map.vertices.id[place_vertex]
    with np.errstate(over="ignore"):
        mixed = q * np.uint64(0x9E3779B97F4A7C15) + (p ^ (p >> np.uint64(31)))
        mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = mixed ^ (mixed >> np.uint64(32))
    return np.asarray(mixed | (mixed == 0).astype(np.uint64))


def banned(vi_map: VIMap, query_vertex: I64, place_vertex: I64) -> Mask:
    """Return which candidates (N,) a user has removed, in either direction."""
    closures = read_record(vi_map).closures
    closures = closures.take(closures.verdict == REMOVED)
    result = np.zeros(len(query_vertex), dtype=np.bool_)
    a, b = (vi_map.vertex_index.rows(ids) for ids in (closures.query, closures.place))
    way, mission = path_lengths(vi_map), vi_map.vertices.mission
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
    closures: Closures,
    use: str,
    *,
    used: Mask | None = None,
    weight: F64 | None = None,
    merges: MergeResult | None = None,
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
    old = read_record(vi_map)
    new = _closure_rows(vi_map, closures, use, used, weight)
    again = IdIndex(new.id).rows(old.closures.id)
    lasting = np.isin(old.closures.use, (USES.index("merge"), USES.index("edge")))
    use_column = new.use.copy()
    is_known = (again >= 0) & lasting
    use_column[again[is_known]] = old.closures.use[is_known]
    kept = (again < 0) & (lasting | (old.closures.verdict == REMOVED))
    table = ClosureRecord.concatenate([old.closures.take(kept), new.replace(use=use_column)])
    record = dataclasses.replace(old, closures=table)
    if merges is not None and before is not None:
        record = _with_merges(record, before, closures, merges)
    return write_record(vi_map, record)


def _closure_rows(
    vi_map: VIMap, c: Closures, use: str, used: Mask | None, weight: F64 | None
) -> ClosureRecord:
    served = c.accepted if used is None else used
    with np.errstate(invalid="ignore"):
        sigma = np.sqrt(np.einsum("nii->ni", c.covariance))
    _, first = np.unique(c.id, axis=0, return_index=True)  # two places may share their vertex
    return ClosureRecord.filled(
        len(c),
        id=c.id,
        query=vi_map.vertices.id[c.query_vertex],
        place=vi_map.vertices.id[c.place_vertex],
        T_A_B=c.T_A_B,
        sigma=sigma,
        matches=c.match_count,
        inliers=c.inlier_count,
        tilt_deg=c.tilt_deg,
        correction_m=c.correction_m,
        correction_deg=c.correction_deg,
        support=c.support,
        verdict=c.verdict,
        use=np.where(served, USES.index(use), 0),
        weight=np.ones(len(c)) if weight is None else weight,
    ).take(np.sort(first))


def _with_merges(
    record: LoopRecord, before: VIMap, closures: Closures, merges: MergeResult
) -> LoopRecord:
    """Append the pairs, the landmarks before merging, and the keypoints that observed them."""
    lm = before.landmarks
    touched = distinct(np.concatenate([merges.first, merges.second]))
    landmarks = MergedLandmarks(
        id=lm.id[touched],
        vertex=before.vertices.id[lm.vertex[touched]],
        p_I=lm.p_I[touched],
        quality=lm.quality[touched],
        feature_type=lm.feature_type[touched],
    )
    keypoint = np.flatnonzero(np.isin(before.keypoints.landmark, touched))
    frame = before.keypoint_frame[keypoint]
    keypoints = MergedKeypoints(
        frame=before.frames.id[frame],
        index=keypoint - before.keypoint_start[frame],
        landmark=lm.id[before.keypoints.landmark[keypoint]],
    )
    pairs = MergePairs.filled(
        len(merges.closure),
        first=lm.id[merges.first],
        second=lm.id[merges.second],
        closure=closures.id[merges.closure],
        wanted=merges.wanted,
    )
    return dataclasses.replace(
        record,
        landmarks=MergedLandmarks.concatenate([record.landmarks, landmarks]),
        keypoints=MergedKeypoints.concatenate([record.keypoints, keypoints]),
        pairs=MergePairs.concatenate([record.pairs, pairs]),
    )
