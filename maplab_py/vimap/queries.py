"""Queries on a map that several algorithms and commands use."""

from collections import Counter
from typing import Any

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import UserError
from maplab_py.sensors.sensor_set import OtherSensor
from maplab_py.vimap.ids import SHORT_ID_DIGITS, distinct_prefixes, to_hex_list
from maplab_py.vimap.tables import LandmarkQuality, MissionSensor, ResourceOwner
from maplab_py.vimap.vi_map import VIMap


def mission_labels(vi_map: VIMap) -> list[str]:
    """Return the label of each mission (M): its name, else the prefix of its id.

    A name that several missions have is followed by the beginning of the id.
    """
    short = [id_[:SHORT_ID_DIGITS] for id_ in to_hex_list(vi_map.missions.id)]
    names = list(vi_map.missions.name)
    counts = Counter(names)
    return [
        (name if counts[name] == 1 else f"{name} ({id_})") if name else id_
        for name, id_ in zip(names, short, strict=True)
    ]


def find_mission(vi_map: VIMap, id_prefix: str) -> int:
    """Return the row of a mission by its name, or by the beginning of its id or name.

    Raises:
        UserError: The text is empty, matches no mission or several; the message lists them.
    """
    prefix = id_prefix.strip().lower()
    ids, names = to_hex_list(vi_map.missions.id), list(vi_map.missions.name)
    if not ids:
        raise UserError("the map has no missions")
    short = distinct_prefixes(ids)
    known = [
        f"{name} ({prefix})" if name else id_
        for id_, prefix, name in zip(ids, short, names, strict=True)
    ]
    rows = [row for row, name in enumerate(names) if name and name == id_prefix.strip()]
    rows = rows or [row for row, id_ in enumerate(ids) if id_.startswith(prefix)]
    rows = rows or [row for row, name in enumerate(names) if name.lower().startswith(prefix)]
    if prefix and len(rows) == 1:
        return rows[0]
    if not prefix:
        raise UserError(f"--map_mission is empty: choose one of {', '.join(known)}")
    if not rows:
        raise UserError(f"no mission begins with '{id_prefix}': the map has {', '.join(known)}")
    candidates = ", ".join(known[row] for row in rows)
    raise UserError(f"'{id_prefix}' is ambiguous: missions begin with it: {candidates}")


def mission_mask(vi_map: VIMap, missions: NDArray[Any] | None) -> Mask:
    """Return a mask (M,) of missions; None = all."""
    mask = np.zeros(len(vi_map.missions), dtype=np.bool_)
    mask[slice(None) if missions is None else missions] = True
    return mask


def landmark_mask(vi_map: VIMap, missions: NDArray[Any] | None) -> Mask:
    """Return which landmarks (L,) are stored in the missions; None = all."""
    chosen = mission_mask(vi_map, missions)
    return chosen[vi_map.vertices.mission[vi_map.landmarks.vertex]]


def observation_counts(vi_map: VIMap) -> I64:
    """Return the number of observations (L,) of each landmark."""
    return np.diff(vi_map.observation_start)


def observer_counts(vi_map: VIMap) -> I64:
    """Return the number of distinct observing vertices (L,) of each landmark."""
    keypoints = vi_map.observations
    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    pairs = distinct(landmark * max(len(vi_map.vertices), 1) + vi_map.keypoint_vertex[keypoints])
    observed = pairs // max(len(vi_map.vertices), 1)
    return np.bincount(observed, minlength=len(vi_map.landmarks))


def observation_matrix(vi_map: VIMap, pairs: tuple[I64, I64] | None = None) -> Any:
    """Return the sparse matrix (V, L) of ones where vertices observe landmarks.

    Args:
        vi_map: The map.
        pairs: Vertices (N,) and landmarks (N,) of observations; None = all of the map.
    """
    from scipy.sparse import csr_array

    rows = vi_map.observations
    ends: Any = pairs or (vi_map.keypoint_vertex[rows], vi_map.keypoints.landmark[rows])
    shape = (len(vi_map.vertices), len(vi_map.landmarks))
    sees = csr_array((np.ones(len(ends[0]), dtype=np.int32), ends), shape=shape)
    sees.sum_duplicates()
    sees.data[:] = 1
    return sees


def coobservation_counts(vi_map: VIMap) -> I64:
    """Return the matrix (M, M) of landmarks that both missions observe; the diagonal: by one."""
    missions, landmarks = len(vi_map.missions), len(vi_map.landmarks)
    keypoints = vi_map.observations
    mission = vi_map.vertices.mission[vi_map.keypoint_vertex[keypoints]]
    seen = np.zeros((missions, landmarks), dtype=np.bool_)
    seen[mission, vi_map.keypoints.landmark[keypoints]] = True
    counts = [[np.count_nonzero(a & b) for b in seen] for a in seen]
    return np.array(counts, dtype=np.int64).reshape(missions, missions)


def mission_clusters(vi_map: VIMap) -> I64:
    """Label missions (M,) that shared landmarks connect.

    A landmark binds its store vertex' mission to those of its observers. Labels are the lowest
    mission row of each cluster.
    """
    mission = vi_map.vertices.mission
    keypoints = vi_map.observations
    home = mission[vi_map.landmarks.vertex[vi_map.keypoints.landmark[keypoints]]]
    pairs = np.stack([home, mission[vi_map.keypoint_vertex[keypoints]]], axis=1)
    label = np.arange(len(vi_map.missions))
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    while len(pairs):
        lowest = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        before = label.copy()
        np.minimum.at(label, pairs[:, 0], lowest)
        np.minimum.at(label, pairs[:, 1], lowest)
        if np.array_equal(label, before):
            break
    return label


def mission_distances_m(vi_map: VIMap) -> F64:
    """Return the length (M,) of each mission's path over its vertices [m]."""
    mission = vi_map.vertices.mission
    step = np.linalg.norm(np.diff(vi_map.vertices.T_M_I[:, 4:], axis=0), axis=1)
    inside = mission[1:] == mission[:-1]
    lengths = np.bincount(mission[1:][inside], step[inside], minlength=len(vi_map.missions))
    return np.asarray(lengths, dtype=np.float64)


def mission_time_spans_ns(vi_map: VIMap) -> I64:
    """Return first and last vertex time (M, 2) of each mission [ns]; zeros for an empty one."""
    start = vi_map.vertex_start
    spans = np.zeros((len(vi_map.missions), 2), dtype=np.int64)
    filled = np.diff(start) > 0
    spans[filled, 0] = vi_map.vertices.timestamp_ns[start[:-1][filled]]
    spans[filled, 1] = vi_map.vertices.timestamp_ns[start[1:][filled] - 1]
    return spans


def has_link(vi_map: VIMap) -> Mask:
    """Return for each vertex row (V,) whether an IMU or relative-pose edge leads to the next row.

    False at the last vertex of each mission.
    """
    linked = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    mission = vi_map.vertices.mission
    for edges in (vi_map.imu_edges, vi_map.transformation_edges):
        low = np.minimum(edges.from_vertex, edges.to_vertex)
        high = np.maximum(edges.from_vertex, edges.to_vertex)
        along = (low >= 0) & (high == low + 1)
        along[along] = mission[low[along]] == mission[high[along]]
        linked[low[along]] = True
    return linked


def mission_sensor_id(vi_map: VIMap, mission: int, kind: MissionSensor) -> str:
    """Return the id (32 hexadecimal digits) of a mission's sensor, empty when it has none."""
    words = vi_map.missions.sensor_id[mission, kind]
    return to_hex_list(words)[0] if words.any() else ""


def resource_missions(vi_map: VIMap) -> I64:
    """Return the mission (row) of every resource (R,), -1 where it belongs to none."""
    table = vi_map.resources
    missions = np.where(table.owner_kind == ResourceOwner.NONE, -1, table.owner).astype(np.int64)
    of_frames = np.flatnonzero(table.owner_kind == ResourceOwner.FRAME)
    vertices = vi_map.frames.vertex[table.owner[of_frames]]
    missions[of_frames] = vi_map.vertices.mission[vertices]
    return missions


def resources_of(
    vi_map: VIMap, kinds: tuple[int, ...] | None = None, missions: NDArray[np.int64] | None = None
) -> Mask:
    """Return which resources (R,) are of some types and missions (rows); None = all."""
    table = vi_map.resources
    chosen = np.ones(len(table), dtype=np.bool_)
    if kinds is not None:
        chosen &= np.isin(table.type, kinds)
    if missions is not None:
        chosen &= np.isin(resource_missions(vi_map), missions)
    return chosen


def without_resources(vi_map: VIMap, removed: Mask) -> VIMap:
    """Return the map without some resources (R,); their files stay where they are."""
    return vi_map.replace(resources=vi_map.resources.take(~removed))


# Marks of missions whose scale and direction of gravity are arbitrary, as those of COLMAP models are.
#
# The mark is a key of the mission's odometry sensor, which stands for the model. It is saved in
# sensors.yaml; C++ maplab ignores it.

ARBITRARY_SCALE = "is_scale_and_gravity_arbitrary"


def is_metric(vi_map: VIMap, mission: int) -> bool:
    """Return whether scale and direction of gravity of a mission (row) are known."""
    sensor_id = mission_sensor_id(vi_map, mission, MissionSensor.ODOMETRY_6DOF)
    sensor = vi_map.sensors.sensors.get(sensor_id)
    return not (isinstance(sensor, OtherSensor) and sensor.keys.get(ARBITRARY_SCALE) is True)


_SHARE_SHOWN = (2.5, 97.5)  # percent: landmarks at large distances would make the rest tiny
_MARGIN = 0.03


def limits_from_above(vi_map: VIMap, missions: NDArray[Any] | None = None) -> tuple[F64, F64]:
    """Return the corners (2,) and (2,) in G of a picture from above: all vertices and 95 % of the landmarks.

    Landmarks that are judged bad do not count, nor do positions that are no numbers.
    """
    p_G = vi_map.T_G_I[mission_mask(vi_map, missions)[vi_map.vertices.mission], 4:6]
    good = vi_map.landmarks.quality != LandmarkQuality.BAD
    landmarks = vi_map.p_G[landmark_mask(vi_map, missions) & good, :2]
    p_G, landmarks = (p[np.isfinite(p).all(axis=1)] for p in (p_G, landmarks))
    if len(landmarks):
        p_G = np.concatenate([p_G, np.percentile(landmarks, _SHARE_SHOWN, axis=0)])
    low, high = p_G.min(axis=0), p_G.max(axis=0)
    margin = _MARGIN * max(float((high - low).max()), 0.1)
    return low - margin, high + margin
