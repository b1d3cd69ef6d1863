"""Append a submap to its mission; neighbouring submaps share their boundary vertex."""

import numpy as np

from maplab_py.array_types import I64
from maplab_py.errors import MapError
from maplab_py.geometry import se3, yaw
from maplab_py.report import Report
from maplab_py.vimap import edits, merge, queries, selection, sensor_merge, tables
from maplab_py.vimap.ids import IdArray, IdIndex, is_valid, to_hex
from maplab_py.vimap.table import ragged_rows
from maplab_py.vimap.vi_map import VIMap

_ALIGNED_M = 1e-9
"""Shared vertices that differ by less [m, rad] need no alignment."""


class AppendReport(Report):
    """Result of appending submaps."""

    submaps: int = 0
    vertices_added: int = 0
    vertices_shared: int = 0
    landmarks_added: int = 0
    landmarks_with_equal_ids: int = 0  # merged because both submaps have the id
    landmarks_united: int = 0  # different ids on one keypoint of a shared vertex
    observations_united: int = 0  # keypoints of shared vertices that had a landmark in both
    largest_shift_m: float = 0.0  # applied to align a submap's boundary vertex with the map's
    largest_yaw_deg: float = 0.0


def append_submap(base: VIMap, submap: VIMap) -> tuple[VIMap, AppendReport]:
    """Append a submap before or after the part of the mission in `base`.

    The shared vertex keeps base's pose, velocity and biases; a submap whose copy of it lies
    elsewhere is moved as a whole (yaw and position). Observations at the shared vertex are merged:
    landmarks of equal id become one, and so do two landmarks that the same keypoint observes (the
    one of better quality survives, then the one with more observations, then base's).

    Raises:
        MapError: `base` lacks the mission, calibrations differ, no vertex is shared, the shared
            vertices' frames differ, or the mission would fall into pieces.
    """
    mission_of = _matching_missions(base, submap)
    if conflicts := sensor_merge.conflicting_sensors(base.sensors, submap.sensors):
        raise MapError(
            f"the submap's sensor {conflicts[0]} has another calibration than the map's: "
            "a mission can have only one"
        )
    submap, shift_m, yaw_rad = _aligned(base, submap)
    stacked = merge.stack(base, submap)
    vertex = _row_in_base(base.vertices.id, submap.vertices.id)
    missing = np.setdiff1d(
        submap.vertices.mission,
        submap.vertices.mission[vertex[len(base.vertices) :] < len(base.vertices)],
    )
    if len(missing):
        raise MapError(_not_adjacent(base, submap, int(mission_of[missing[0]]), int(missing[0])))
    stacked, united_observations, from_rows, into_rows = _unite_vertices(
        stacked, base, mission_of, vertex
    )
    landmark = _row_in_base(base.landmarks.id, submap.landmarks.id)
    equal = np.flatnonzero(landmark != np.arange(len(landmark)))
    joined, collisions = _unite_landmarks(stacked, equal, landmark[equal], from_rows, into_rows)
    _check_connected(base, submap, joined)
    report = AppendReport(
        submaps=1,
        vertices_added=len(joined.vertices) - len(base.vertices),
        vertices_shared=len(base.vertices) + len(submap.vertices) - len(joined.vertices),
        landmarks_added=len(joined.landmarks) - len(base.landmarks),
        landmarks_with_equal_ids=len(equal),
        landmarks_united=collisions,
        observations_united=united_observations,
        largest_shift_m=shift_m,
        largest_yaw_deg=float(np.rad2deg(yaw_rad)),
    )
    return joined, report


def _matching_missions(base: VIMap, submap: VIMap) -> I64:
    rows = base.mission_index.rows(submap.missions.id)
    if np.any(rows < 0):
        name = to_hex(submap.missions.id[np.flatnonzero(rows < 0)[0]])
        raise MapError(
            f"the map has no mission {name} to append the submap to: use load_merge_map for "
            "another mission"
        )
    return rows


def _row_in_base(base_ids: IdArray, other_ids: IdArray) -> I64:
    """Return the base row (B + O,) of each stacked row, or its row in the stack where the id is new."""
    rows = np.arange(len(base_ids) + len(other_ids))
    base_rows = IdIndex(base_ids).rows(other_ids)
    known = (base_rows >= 0) & is_valid(other_ids)
    rows[len(base_ids) :][known] = base_rows[known]
    return rows


def _aligned(base: VIMap, submap: VIMap) -> tuple[VIMap, float, float]:
    """Move each of the submap's missions so that its first shared vertex lies on base's."""
    rows = base.vertex_index.rows(submap.vertices.id)
    shift_m, yaw_rad = 0.0, 0.0
    for mission in range(len(submap.missions)):
        shared = np.flatnonzero((rows >= 0) & (submap.vertices.mission == mission))
        if len(shared) == 0:
            continue
        T_M_I = base.vertices.T_M_I[rows[shared[0]]]
        T_N_I = submap.vertices.T_M_I[shared[0]]
        T_M_N = yaw.from_pose(se3.compose(T_M_I, se3.inverse(T_N_I)))
        # roll and pitch do not change: rotate about the vertex, not about the origin
        T_M_N[:3] = T_M_I[4:] - yaw.rotate(T_M_N[3], T_N_I[4:])
        shift = float(np.linalg.norm(T_M_I[4:] - T_N_I[4:]))
        if max(shift, abs(T_M_N[3])) > _ALIGNED_M:
            submap = edits.transform_mission(submap, mission, yaw.to_pose(T_M_N))
            shift_m, yaw_rad = max(shift_m, shift), max(yaw_rad, abs(float(T_M_N[3])))
    return submap, shift_m, yaw_rad


def _unite_vertices(
    stacked: VIMap, base: VIMap, mission_of: I64, vertex: I64
) -> tuple[VIMap, int, I64, I64]:
    """Redirect everything to the base's copies of vertices, frames and missions, and drop the rest.

    Returns:
        The map, the number of keypoints with a landmark in both submaps, and the pairs of
        landmarks (stacked rows, rows) that these keypoints bind together.
    """
    mission = np.concatenate([np.arange(len(base.missions)), mission_of])
    frame_twin = _twin_frames(stacked, vertex, len(base.frames))
    twins = np.flatnonzero(frame_twin >= 0)
    mine = ragged_rows(stacked.keypoint_start, frame_twin[twins])
    theirs = ragged_rows(stacked.keypoint_start, twins)
    landmark = stacked.keypoints.landmark.copy()
    a, b = landmark[mine], landmark[theirs]
    both = (a >= 0) & (b >= 0)
    landmark[mine] = np.where(a >= 0, a, b)
    landmark[theirs] = tables.NO_ROW
    stacked = stacked.replace(keypoints=stacked.keypoints.replace(landmark=landmark))
    redirected = _redirected(stacked, mission, vertex, frame_twin)
    kept = np.flatnonzero(vertex == np.arange(len(vertex)))
    table = redirected.vertices
    order = np.lexsort((table.timestamp_ns[kept], table.mission[kept]))
    united = selection.keep_rows(
        redirected, missions=np.arange(len(base.missions)), vertices=kept[order]
    )
    return united, int(both.sum()), b[both].astype(np.int64), a[both].astype(np.int64)


def _twin_frames(stacked: VIMap, vertex: I64, base_frames: int) -> I64:
    """Return base's frame (F,) of the same vertex and camera for frames of the submap, else -1."""
    frames = stacked.frames
    width = int(frames.camera_index.max(initial=0)) + 1
    slot = vertex[frames.vertex] * width + frames.camera_index
    of_slot = np.full(len(vertex) * width, -1, dtype=np.int64)
    of_slot[slot[:base_frames]] = np.arange(base_frames)
    twin: I64 = of_slot[slot]
    twin[:base_frames] = -1
    rows = np.flatnonzero(twin >= 0)
    differ = rows[frames.keypoint_count[rows] != frames.keypoint_count[twin[rows]]]
    if len(differ):
        raise MapError(
            f"frame {to_hex(frames.id[differ[0]])} of the shared vertex has "
            f"{frames.keypoint_count[differ[0]]} keypoints in the submap and "
            f"{frames.keypoint_count[twin[differ[0]]]} in the map"
        )
    return twin


def _redirected(stacked: VIMap, mission: I64, vertex: I64, frame_twin: I64) -> VIMap:
    """Point references at base's copies; frames that are there twice lose their vertex."""
    table, frames, landmarks = stacked.vertices, stacked.frames, stacked.landmarks
    shared = np.flatnonzero(vertex != np.arange(len(vertex)))
    nframe_id = table.nframe_id.copy()
    lacking = shared[~is_valid(nframe_id[vertex[shared]])]
    nframe_id[vertex[lacking]] = nframe_id[lacking]
    parts: dict[str, object] = {}
    for name in ("transformation_edges", "loop_closure_edges"):
        edges = getattr(stacked, name)
        edges = edges.replace(
            from_vertex=vertex[edges.from_vertex], to_vertex=vertex[edges.to_vertex]
        )
        parts[name] = edges.take(_first_of_id(edges.id))
    imu = stacked.imu_edges
    once = _first_of_id(imu.id)
    redirected = imu.replace(from_vertex=vertex[imu.from_vertex], to_vertex=vertex[imu.to_vertex])
    return stacked.replace(
        vertices=table.replace(mission=mission[table.mission], nframe_id=nframe_id),
        frames=frames.replace(
            vertex=np.where(frame_twin >= 0, tables.NO_ROW, vertex[frames.vertex])
        ),
        landmarks=landmarks.replace(vertex=vertex[landmarks.vertex]),
        imu_edges=redirected.take(once),
        imu_samples=stacked.imu_samples.take(ragged_rows(stacked.sample_start, once)),
        absolute_poses=_absolute_poses_once(stacked, vertex),
        resources=_resources_once(stacked, mission, frame_twin),
        **parts,
    )


def _absolute_poses_once(stacked: VIMap, vertex: I64) -> tables.AbsolutePoses:
    absolute = stacked.absolute_poses
    absolute = absolute.replace(vertex=vertex[absolute.vertex])
    keys = np.stack(
        [absolute.vertex.astype(np.uint64), absolute.timestamp_ns.astype(np.uint64)], axis=1
    )
    return absolute.take(_first_of_id(np.concatenate([keys, absolute.sensor_id], axis=1)))


def _resources_once(stacked: VIMap, mission: I64, frame_twin: I64) -> tables.Resources:
    resources = stacked.resources
    owner = resources.owner.astype(np.int64)
    by_frame = resources.owner_kind == tables.ResourceOwner.FRAME
    by_mission = ~by_frame & (resources.owner_kind != tables.ResourceOwner.NONE)
    frame = np.where(frame_twin >= 0, frame_twin, np.arange(len(frame_twin)))
    owner[by_frame] = frame[owner[by_frame]]
    owner[by_mission] = mission[owner[by_mission]]
    resources = resources.replace(owner=owner)
    numbers = (resources.type, resources.owner_kind, resources.owner, resources.timestamp_ns)
    keys = np.stack([column.astype(np.uint64) for column in numbers], axis=1)
    return resources.take(_first_of_id(np.concatenate([keys, resources.id], axis=1)))


def _first_of_id(ids: IdArray) -> I64:
    """Return the first row of each id or other key (N, k), in row order."""
    _, first = np.unique(ids, axis=0, return_index=True)
    return np.asarray(np.sort(first), dtype=np.int64)


def _unite_landmarks(
    stacked: VIMap, equal_from: I64, equal_into: I64, from_rows: I64, into_rows: I64
) -> tuple[VIMap, int]:
    """Merge landmarks of equal id, then those joined by a keypoint; also return the latter count."""
    count = np.diff(stacked.observation_start)
    target = np.arange(len(stacked.landmarks))
    target[equal_from] = equal_into
    a, b = target[into_rows], target[from_rows]
    bound = a != b
    a, b = a[bound], b[bound]
    quality = stacked.landmarks.quality
    swap = (quality[b] > quality[a]) | ((quality[b] == quality[a]) & (count[b] > count[a]))
    into, source = np.where(swap, b, a), np.where(swap, a, b)
    # equal ids: base's row always survives, so pairs are expressed in base's rows already
    merged = edits.merge_landmarks(stacked, equal_from, equal_into)
    kept = np.setdiff1d(np.arange(len(stacked.landmarks)), equal_from)
    new_row = np.full(len(stacked.landmarks), -1, dtype=np.int64)
    new_row[kept] = np.arange(len(kept))
    united = edits.merge_landmarks(merged, new_row[source], new_row[into])
    return united, len(merged.landmarks) - len(united.landmarks)


def _not_adjacent(base: VIMap, submap: VIMap, base_row: int, row: int) -> str:
    def span(vi_map: VIMap, mission: int) -> str:
        times = vi_map.vertices.timestamp_ns[vi_map.vertices.mission == mission]
        return f"{times.min()} .. {times.max()} ns"

    return (
        f"the submap ({span(submap, row)}) shares no vertex with mission "
        f"{to_hex(base.missions.id[base_row])} of the map ({span(base, base_row)}): "
        "append the submaps between them first"
    )


def _check_connected(base: VIMap, submap: VIMap, joined: VIMap) -> None:
    def gaps(vi_map: VIMap) -> int:
        mission = vi_map.vertices.mission
        return int(np.count_nonzero(~queries.has_link(vi_map)[:-1] & (mission[1:] == mission[:-1])))

    if gaps(joined) > gaps(base) + gaps(submap):
        mission = joined.vertices.mission
        rows = np.flatnonzero(~queries.has_link(joined)[:-1] & (mission[1:] == mission[:-1]))
        raise MapError(
            f"appending the submap would leave no edge between vertices "
            f"{to_hex(joined.vertices.id[rows[0]])} and {to_hex(joined.vertices.id[rows[0] + 1])}: "
            "the submap overlaps the map instead of adjoining it"
        )
