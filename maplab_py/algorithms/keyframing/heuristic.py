"""Heuristic keyframing: keep vertices of each mission that add new information."""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.keyframing.options import KeyframingOptions, KeyframingReport
from maplab_py.distinct import distinct
from maplab_py.geometry import se3
from maplab_py.progress import SILENT, Progress
from maplab_py.report import counted
from maplab_py.vimap import VIMap, mission_mask, observation_counts, starts_of_counts
from maplab_py.vimap.vertex_removal import remove_vertices_counted


class Reason(IntEnum):
    """Reason why a vertex is a keyframe, in the order of maplab's checks."""

    NONE = 0
    MISSION_END = 1
    EVERY_NTH = 2
    FEW_SHARED_LANDMARKS = 3
    ABSOLUTE_POSE = 4
    LOOP_CLOSURE = 5
    DISTANCE = 6
    ROTATION = 7


def keyframe(
    vi_map: VIMap,
    options: KeyframingOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> tuple[VIMap, KeyframingReport]:
    """Keep keyframes and remove the vertices between them.

    First and last vertices stay. IMU edges are concatenated and odometry composed over removed
    vertices; landmarks stay where they are but lose the removed observations.
    """
    reason = choose_keyframes(vi_map, options, missions=missions, progress=progress)
    chosen = mission_mask(vi_map, missions)[vi_map.vertices.mission]
    result, removal = remove_vertices_counted(vi_map, chosen & (reason == Reason.NONE))
    count = np.bincount(reason[chosen], minlength=len(Reason))
    had = observation_counts(vi_map) >= 2
    undetermined = int(np.count_nonzero(had & (observation_counts(result) < 2)))
    report = KeyframingReport(
        vertices_before=int(chosen.sum()),
        vertices_after=int(chosen.sum()) - removal.vertices,
        mission_ends=int(count[Reason.MISSION_END]),
        every_nth=int(count[Reason.EVERY_NTH]),
        few_shared_landmarks=int(count[Reason.FEW_SHARED_LANDMARKS]),
        absolute_pose=int(count[Reason.ABSOLUTE_POSE]),
        loop_closure=int(count[Reason.LOOP_CLOSURE]),
        distance=int(count[Reason.DISTANCE]),
        rotation=int(count[Reason.ROTATION]),
        observations_removed=removal.observations,
        landmarks_moved=removal.landmarks_moved,
        landmarks_undetermined=undetermined,
        imu_edges_dropped=removal.imu_edges_dropped,
        transformation_edges_dropped=removal.transformation_edges_dropped,
        resources_removed=removal.resources,
        note=_note(undetermined, int(np.count_nonzero(had)), removal.resources),
    )
    return result, report


def _note(undetermined: int, landmarks: int, resources: int) -> str:
    notes = []
    if 2 * undetermined > landmarks:
        notes.append(
            f"{undetermined} of {landmarks} landmarks keep fewer than two observations and are bad until lc "
            "merges them; a smaller --kf_every_nth_vertex or larger --kf_min_shared_landmarks_obs keeps more"
        )
    if resources:
        notes.append(
            f"{counted(resources, 'image or depth map', 'images and depth maps')} of removed vertices went "
            "with them: a dense map is better made before (undo; stereo_dense_reconstruction)"
        )
    return "; ".join(notes)


def choose_keyframes(
    vi_map: VIMap,
    options: KeyframingOptions,
    *,
    missions: NDArray[np.int64] | None = None,
    progress: Progress = SILENT,
) -> NDArray[np.int8]:
    """Return the reason why each vertex (V,) is a keyframe, or `Reason.NONE`.

    Vertices of other missions are `Reason.NONE` too. The loop is sequential because each decision
    depends on the last keyframe.
    """
    walk = _Walk(vi_map, options)
    reason = np.zeros(len(vi_map.vertices), dtype=np.int8)
    start = vi_map.vertex_start
    for mission in np.flatnonzero(mission_mask(vi_map, missions)).tolist():
        progress.check()
        first, end = int(start[mission]), int(start[mission + 1])
        if first == end:
            continue
        reason[[first, end - 1]] = Reason.MISSION_END
        walk.begin(first)
        for vertex in range(first + 1, end - 1):
            reason[vertex] = walk.verdict(vertex)
            if reason[vertex] != Reason.NONE:
                walk.begin(vertex)
    return reason


class _Walk:
    """Loop state: the last keyframe and the landmarks that it observes."""

    def __init__(self, vi_map: VIMap, options: KeyframingOptions) -> None:
        self._options = options
        self._T_M_I = vi_map.vertices.T_M_I
        seeing = np.flatnonzero(vi_map.keypoints.landmark >= 0)
        vertex = vi_map.keypoint_vertex[seeing].astype(np.int64)
        landmarks = max(len(vi_map.landmarks), 1)
        pairs = distinct(vertex * landmarks + vi_map.keypoints.landmark[seeing])
        self._landmark = pairs % landmarks
        count = np.bincount(pairs // landmarks, minlength=len(vi_map.vertices))
        self._start = starts_of_counts(count)
        self._seen_from = np.full(landmarks, -1, dtype=np.int64)
        self._has_frames = np.diff(vi_map.frame_start) > 0
        self._has_absolute_pose = np.zeros(len(vi_map.vertices), dtype=np.bool_)
        self._has_absolute_pose[vi_map.absolute_poses.vertex] = True
        self._has_loop_closure = np.zeros(len(vi_map.vertices), dtype=np.bool_)
        self._has_loop_closure[vi_map.loop_closure_edges.from_vertex] = True
        self._has_loop_closure[vi_map.loop_closure_edges.to_vertex] = True
        self._last = -1

    def _landmarks(self, vertex: int) -> NDArray[np.int64]:
        return self._landmark[self._start[vertex] : self._start[vertex + 1]]

    def begin(self, vertex: int) -> None:
        """Make a vertex the last keyframe."""
        self._last = vertex
        self._seen_from[self._landmarks(vertex)] = vertex

    def verdict(self, vertex: int) -> Reason:
        """Return the first reason to make this vertex a keyframe."""
        o = self._options
        if vertex - self._last >= o.every_nth_vertex:
            return Reason.EVERY_NTH
        shared = np.count_nonzero(self._seen_from[self._landmarks(vertex)] == self._last)
        if self._has_frames[vertex] and shared < o.min_shared_landmarks_obs:
            return Reason.FEW_SHARED_LANDMARKS
        if self._has_absolute_pose[vertex]:
            return Reason.ABSOLUTE_POSE
        if self._has_loop_closure[vertex]:
            return Reason.LOOP_CLOSURE
        step = se3.local(self._T_M_I[self._last], self._T_M_I[vertex])
        if np.linalg.norm(step[:3]) > o.distance_threshold_m:
            return Reason.DISTANCE
        if np.rad2deg(np.linalg.norm(step[3:])) > o.rotation_threshold_deg:
            return Reason.ROTATION
        return Reason.NONE
