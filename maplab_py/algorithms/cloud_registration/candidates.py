"""Pairs of clouds that may show the same place."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.algorithms.cloud_registration.scans import Scans
from maplab_py.algorithms.loop_closure.closure_record import read_record
from maplab_py.algorithms.loop_closure.closure_table import VERDICTS
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask
from maplab_py.errors import UserError
from maplab_py.geometry import se3
from maplab_py.geometry.association import nearest_rows
from maplab_py.vimap import VIMap


@dataclasses.dataclass(frozen=True, eq=False)
class CloudPairs:
    """Pairs (N) of clouds: the later one, or that of the later mission, is the query."""

    query: I64  # (N,) rows of the scans
    place: I64  # (N,)
    T_P_Q: F64  # (N, 7) initial pose of the query's sensor in that of the place; NaN = unknown

    def __len__(self) -> int:
        return len(self.query)


def pairs_by_position(vi_map: VIMap, scans: Scans, options: CloudClosureOptions) -> CloudPairs:
    """Return for every cloud the nearest ones of each mission, and some that precede it.

    Nearest are those by the present poses. Missions of unknown base frame are compared with themselves
    only.
    """
    from scipy.spatial import cKDTree

    p_G = scans.T_G_S[:, 4:]
    near = cKDTree(p_G).query_pairs(options.max_distance_m, output_type="ndarray")
    place, query = near.min(axis=1, initial=len(scans)), near.max(axis=1, initial=-1)
    known = vi_map.baseframes.is_known[vi_map.missions.baseframe]
    a, b = scans.mission[query], scans.mission[place]
    chosen = ((a == b) & _apart(scans, query, place, options)) | ((a != b) & known[a] & known[b])
    query, place = query[chosen], place[chosen]
    distance = np.linalg.norm(p_G[query] - p_G[place], axis=1)
    query, place = _nearest_of_each(scans, query, place, distance, options.max_candidates)
    following, preceding = _in_sequence(scans, options)
    both = np.stack([np.append(query, following), np.append(place, preceding)])
    query, place = np.unique(both, axis=1)
    return CloudPairs(query, place, se3.relative(scans.T_G_S[place], scans.T_G_S[query]))


def pairs_from_closures(vi_map: VIMap, scans: Scans, options: CloudClosureOptions) -> CloudPairs:
    """Return the clouds nearest to the ends of recorded closures.

    Raises:
        UserError: No accepted closure is recorded.
    """
    closures = read_record(vi_map).closures
    closures = closures.take(closures.verdict == VERDICTS.index(Verdict.ACCEPTED))
    if not len(closures):
        raise UserError("--lidar_lc_from_closures: the map records no accepted closure (see: lc)")
    a = vi_map.vertex_index.rows(closures.query)
    b = vi_map.vertex_index.rows(closures.place)
    query, place = _cloud_of_vertex(vi_map, scans, a), _cloud_of_vertex(vi_map, scans, b)
    usable = (query >= 0) & (place >= 0) & (query != place)
    a, b, query, place = a[usable], b[usable], query[usable], place[usable]
    _, first = np.unique(np.stack([query, place]), axis=1, return_index=True)
    rows = np.flatnonzero(usable)[first]
    a, b, query, place = a[first], b[first], query[first], place[first]
    T_Q_A = se3.relative(scans.T_G_S[query], vi_map.T_G_I[a])
    T_B_P = se3.relative(vi_map.T_G_I[b], scans.T_G_S[place])
    T_Q_P = se3.compose(se3.compose(T_Q_A, closures.T_A_B[rows]), T_B_P)
    far = np.linalg.norm(T_Q_P[:, 4:], axis=1) > options.max_distance_m
    keep = np.flatnonzero(~far)
    return CloudPairs(query[keep], place[keep], se3.inverse(T_Q_P[keep]))


def pairs_everywhere(scans: Scans, options: CloudClosureOptions) -> CloudPairs:
    """Return for every cloud some of each mission, spread evenly along it, without initial poses."""
    query, place = [], []
    for mission in np.unique(scans.mission).tolist():
        of_mission = np.flatnonzero(scans.mission == mission)
        count = min(options.max_candidates, len(of_mission))
        later = np.flatnonzero(scans.mission >= mission)
        # a shift from query to query makes neighbouring queries try different places
        step = len(of_mission) / count
        shift = (np.arange(len(later)) * step / max(len(later), 1) * count) % step
        chosen = (np.arange(count) * step + shift[:, None]).astype(np.int64) % len(of_mission)
        query.append(np.repeat(later, count))
        place.append(of_mission[chosen].reshape(-1))
    q, p = np.concatenate(query), np.concatenate(place)
    other = scans.mission[q] != scans.mission[p]
    keep = other | ((q > p) & _apart(scans, q, p, options))
    pairs = np.unique(np.stack([q[keep], p[keep]]), axis=1)
    return CloudPairs(pairs[0], pairs[1], np.full((pairs.shape[1], 7), np.nan))


def _apart(scans: Scans, query: I64, place: I64, options: CloudClosureOptions) -> Mask:
    gap_s = np.abs(scans.time_ns[query] - scans.time_ns[place]) * 1e-9
    return np.asarray(gap_s >= options.min_time_gap_s)


def _in_sequence(scans: Scans, options: CloudClosureOptions) -> tuple[I64, I64]:
    """Return clouds and those of the same mission one and two gaps earlier, unless they are too far."""
    gap_ns = round(options.sequence_gap_s * 1e9)
    query, place = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for mission in np.unique(scans.mission).tolist() if gap_ns else []:
        rows = np.flatnonzero(scans.mission == mission)
        rows = rows[np.argsort(scans.time_ns[rows], kind="stable")]
        time_ns = scans.time_ns[rows]
        for wanted_ns in (gap_ns, 2 * gap_ns):
            earlier = nearest_rows(time_ns, time_ns - wanted_ns)
            is_near = np.abs(time_ns - time_ns[earlier] - wanted_ns) < gap_ns // 2
            query.append(rows[is_near])
            place.append(rows[earlier[is_near]])
    q, p = np.concatenate(query), np.concatenate(place)
    distance = np.linalg.norm(scans.T_G_S[q, 4:] - scans.T_G_S[p, 4:], axis=1)
    near = (distance <= options.max_distance_m) & (q != p)
    return q[near], p[near]


def _nearest_of_each(
    scans: Scans, query: I64, place: I64, distance: F64, count: int
) -> tuple[I64, I64]:
    """Keep the nearest places of each query in each mission."""
    mission = scans.mission[place]
    order = np.lexsort((place, distance, mission, query))
    q, m = query[order], mission[order]
    is_first = np.ones(len(order), dtype=np.bool_)
    is_first[1:] = (q[1:] != q[:-1]) | (m[1:] != m[:-1])
    start = np.flatnonzero(is_first)
    rank = np.arange(len(order)) - np.repeat(start, np.diff(np.append(start, len(order))))
    kept = np.sort(order[rank < count])
    return query[kept], place[kept]


def _cloud_of_vertex(vi_map: VIMap, scans: Scans, vertex: I64) -> I64:
    """Return the cloud (N,) nearest in time to vertices, -1 where the mission has none."""
    result = np.full(len(vertex), -1, dtype=np.int64)
    mission = vi_map.vertices.mission[vertex]
    for row in np.unique(scans.mission).tolist():
        clouds = np.flatnonzero(scans.mission == row)
        clouds = clouds[np.argsort(scans.time_ns[clouds], kind="stable")]
        here = np.flatnonzero(mission == row)
        stamp = vi_map.vertices.timestamp_ns[vertex[here]]
        result[here] = clouds[nearest_rows(scans.time_ns[clouds], stamp)]
    return result
