"""Scans of missions, and pairs of scans that may overlap."""

import itertools
from functools import lru_cache
from pathlib import Path

import numpy as np

from maplab_py.algorithms.cloud_registration.options import CloudClosureOptions
from maplab_py.algorithms.cloud_registration.registration import PreparedCloud, prepare_cloud
from maplab_py.algorithms.loop_closure import closure_record, closure_table
from maplab_py.algorithms.loop_closure.reports import Verdict
from maplab_py.array_types import F64, I64, Mask, NDArray, Rows
from maplab_py.errors import MapError, UserError
from maplab_py.geometry import interpolation, se3
from maplab_py.interop.ply import parse_ply
from maplab_py.storage.resources.store import ResourceStore
from maplab_py.vimap import MissionSensor, ResourceOwner, VIMap, as_keys, queries, to_hex

CLOUD_TYPES = (16, 17, 21)
"""Resource types of clouds: plain, with colours, with intensities."""
_KEPT = 400
"""Number of prepared clouds in memory."""


class Scans(Rows):
    """Clouds (N) of sensors, by mission and time; S is the sensor at the time of the cloud."""

    resource: I64  # (N,) rows
    mission: I64  # (N,) rows
    time_ns: I64  # (N,)
    vertex: I64  # (N,) row of the vertex nearest in time
    T_V_S: F64  # (N, 7) in the body frame of that vertex
    T_G_S: F64  # (N, 7)


def map_scans(vi_map: VIMap, missions: I64, every_nth: int = 1) -> Scans:
    """Return the clouds of the sensors of some missions (rows).

    Clouds of times without vertices nearby (outside the mission) are left out.

    Raises:
        UserError: There is none.
        MapError: A sensor has no extrinsics.
    """
    table = vi_map.resources
    chosen = queries.resources_of(vi_map, CLOUD_TYPES, missions)
    chosen &= table.owner_kind == ResourceOwner.SENSOR
    rows = np.flatnonzero(chosen)
    keys = as_keys(table.sensor_id[rows])
    order = np.lexsort((table.timestamp_ns[rows], keys, table.owner[rows]))
    parts = []
    for group in _groups(table.owner[rows][order], keys[order]):
        inside = _of_sensor(vi_map, rows[order[group]][::every_nth])
        if len(inside):
            parts.append(inside)
    if not parts:
        raise UserError(
            "the map has no clouds of a sensor: import_point_clouds attaches some (clouds of cameras "
            "are not registered)"
        )
    return Scans.concatenate(parts)


def _groups(owner: NDArray[np.int32], keys: NDArray[np.void]) -> list[slice]:
    """Return the runs of equal owner and sensor."""
    if not len(owner):
        return []
    change = np.flatnonzero((owner[1:] != owner[:-1]) | (keys[1:] != keys[:-1])) + 1
    return [slice(a, b) for a, b in itertools.pairwise([0, *change.tolist(), len(owner)])]


def _of_sensor(vi_map: VIMap, rows: I64) -> Scans:
    """Return the clouds (rows of resources, by time) of a sensor in one mission."""
    table = vi_map.resources
    mission = int(table.owner[rows[0]])
    first, last = vi_map.vertex_start[mission : mission + 2].tolist()
    times = vi_map.vertices.timestamp_ns[first:last]
    if len(times):
        stamp = table.timestamp_ns[rows]
        rows = rows[(stamp >= times[0]) & (stamp <= times[-1])]
    if not len(times) or not len(rows):
        rows = rows[:0]
    stamp = table.timestamp_ns[rows]
    empty = np.zeros((0, 7))
    if not len(rows):
        none = np.zeros(0, dtype=np.int64)
        return Scans(none, none, none, none, empty, empty)
    T_G_I, _ = interpolation.interpolate_poses(times, vi_map.T_G_I[first:last], stamp)
    imu_id = queries.mission_sensor_id(vi_map, mission, MissionSensor.IMU)
    T_I_S = vi_map.sensors.T_I_S(imu_id, to_hex(table.sensor_id[rows[0]]))
    T_G_S = se3.compose(T_G_I, T_I_S)
    vertex = first + interpolation.nearest_rows(times, stamp)
    return Scans(
        rows,
        np.full(len(rows), mission, dtype=np.int64),
        stamp.astype(np.int64),
        vertex,
        se3.relative(vi_map.T_G_I[vertex], T_G_S),
        T_G_S,
    )


class CloudReader:
    """Reads and prepares clouds; keeps the latest ones."""

    def __init__(self, vi_map: VIMap, map_folder: Path, voxel_size_m: float) -> None:
        """Serve the clouds of a map whose resources are in its folder."""
        self._vi_map, self._store = vi_map, ResourceStore(vi_map, map_folder)
        self._voxel_size_m = voxel_size_m
        self.cloud = lru_cache(maxsize=_KEPT)(self._read)
        """Return the prepared cloud of a resource (row); MapError if it is damaged or too small."""

    def _read(self, row: int) -> PreparedCloud:
        name = f"cloud {to_hex(self._vi_map.resources.id[row])}"
        points = parse_ply(self._store.load(row), name).p
        if not np.isfinite(points).all():
            raise MapError(f"{name} has points that are not finite: remove_resources, import again")
        return prepare_cloud(points, self._voxel_size_m, name)


class CloudPairs(Rows):
    """Pairs (N) of clouds: the later one, or that of the later mission, is the query."""

    query: I64  # (N,) rows of the scans
    place: I64  # (N,)
    T_P_Q: F64  # (N, 7) initial pose of the query's sensor in that of the place; NaN = unknown


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
    closures = closure_record.read_record(vi_map).closures
    closures = closures.take(closures.verdict == closure_table.VERDICTS.index(Verdict.ACCEPTED))
    if not len(closures):
        raise UserError(
            "--lidar_lc_from_closures: the map records no accepted closure (see: lc)",
            remedy="loopclosure_all_missions",
        )
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
            earlier = interpolation.nearest_rows(time_ns, time_ns - wanted_ns)
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
        result[here] = clouds[interpolation.nearest_rows(scans.time_ns[clouds], stamp)]
    return result
