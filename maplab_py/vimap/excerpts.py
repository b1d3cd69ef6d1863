"""Parts of a map that are edited separately and written back into the map."""

import dataclasses
import hashlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import I32, I64, Mask, mask_of
from maplab_py.distinct import distinct
from maplab_py.vimap import edits, ids, selection, table, tables, vertex_removal
from maplab_py.vimap.vi_map import VIMap


@dataclasses.dataclass(frozen=True, eq=False)
class Excerpt:
    """A part of a map."""

    source: VIMap  # the whole map
    vi_map: VIMap  # the part, with the ids of the whole
    missions: I64  # its missions as rows of the whole
    vertices: I64  # its vertices likewise
    landmarks: I64  # its landmarks likewise
    keypoints: I64  # its keypoints likewise

    def written_back(self, edited: VIMap, *, vertices: ArrayLike | None = None) -> VIMap:
        """Return the whole map with the states and landmarks of the edited part.

        Poses, velocities, biases, base frames, and the positions and qualities of landmarks are
        taken over. Landmarks that were merged in the part are merged in the whole map, with all
        their observations; keypoints of the part observe what they observe in the edited part.

        Args:
            edited: The part after edits that keep its missions, vertices and keypoints and add no
                landmarks.
            vertices: Vertices of the part (rows or a mask) whose states are taken over; None = all.

        Raises:
            ValueError: The edit has changed what it must keep.
        """
        for name in ("missions", "vertices", "keypoints"):
            if len(getattr(edited, name)) != len(getattr(self.vi_map, name)):
                raise ValueError(f"the edit has changed the number of {name}")
        rows = np.arange(len(self.vertices)) if vertices is None else np.asarray(vertices)
        whole = self._with_observations(self._with_states(edited, rows), edited)
        rows = whole.landmark_index.rows(edited.landmarks.id)
        judged = whole.landmarks.put(rows, quality=edited.landmarks.quality)
        whole = whole.replace(landmarks=judged)
        moved = self._moved(whole, rows, edited)
        return edits.with_p_G(whole, rows[moved], edited.p_G[moved])

    def _moved(self, whole: VIMap, rows: I64, edited: VIMap) -> Mask:
        """Return which landmarks of the edited part, rows of the whole, must get their positions.

        The others keep their p_I to the last bit: they, and the vertex that stores them, are where they were.
        """
        before = self.vi_map.landmark_index.rows(edited.landmarks.id)
        has_moved = (edited.p_G != self.vi_map.p_G[before]).any(axis=1)
        source = self.source.vertices
        vertex = whole.landmarks.vertex[rows]
        state_is_new = (whole.vertices.T_M_I[vertex] != source.T_M_I[vertex]).any(axis=1)
        frame = whole.missions.baseframe[whole.vertices.mission[vertex]]
        frame_is_new = (whole.baseframes.T_G_M[frame] != self.source.baseframes.T_G_M[frame]).any(
            axis=1
        )
        return np.asarray(has_moved | state_is_new | frame_is_new)

    def _with_states(self, edited: VIMap, changed: NDArray[Any]) -> VIMap:
        v, whole = edited.vertices, self.source.vertices
        columns = {}
        for name in ("T_M_I", "v_M", "gyro_bias", "accel_bias"):
            columns[name] = getattr(whole, name).copy()
            columns[name][self.vertices[changed]] = getattr(v, name)[changed]
        rows = self.source.missions.baseframe[self.missions]
        frames, of = self.source.baseframes, edited.missions.baseframe
        now = edited.baseframes.take(of)
        return self.source.replace(
            vertices=whole.replace(**columns),
            baseframes=frames.put(rows, T_G_M=now.T_G_M, is_known=now.is_known),
        )

    def _with_observations(self, whole: VIMap, edited: VIMap) -> VIMap:
        kept = self.vi_map.landmark_index.rows(edited.landmarks.id)  # rows of the part
        before, after = self.vi_map.keypoints.landmark, edited.keypoints.landmark
        after = np.append(kept, tables.NO_ROW)[after]
        if len(kept) == len(self.landmarks) and np.array_equal(before, after):
            return whole
        is_kept = mask_of(len(self.landmarks) + 1, kept)
        moved = np.flatnonzero((before >= 0) & ~is_kept[before] & (after >= 0))
        source, target = _most_frequent(before[moved], after[moved])
        merged = edits.merge_landmarks(whole, self.landmarks[source], self.landmarks[target])
        rows = merged.landmark_index.rows(self.source.landmarks.id[self.landmarks])
        landmark = np.append(rows, tables.NO_ROW)[after]
        merged = merged.replace(keypoints=merged.keypoints.put(self.keypoints, landmark=landmark))
        absent = rows[~is_kept[:-1]]
        absent = absent[absent >= 0]
        return edits.remove_landmarks(
            merged, absent[np.diff(merged.observation_start)[absent] == 0]
        )


def _most_frequent(source: I32, target: I32) -> tuple[I64, I64]:
    """Return each source once, with the target that it is paired with most often."""
    pairs, count = np.unique(np.stack([source, target]), axis=1, return_counts=True)
    order = np.lexsort((pairs[1], -count, pairs[0]))
    pairs = pairs[:, order].astype(np.int64)
    first = np.unique(pairs[0], return_index=True)[1]
    return pairs[0, first], pairs[1, first]


def excerpt(vi_map: VIMap, vertices: ArrayLike, *, observed_by: ArrayLike | None = None) -> Excerpt:
    """Return the part of a map at some vertices.

    It has the missions of these vertices, the edges between two of them, and the landmarks that they
    observe. A landmark that another vertex stores is stored in its first observer of the part.

    Args:
        vertices: Vertex rows or a mask (V,).
        observed_by: Vertices (rows or a mask) of which one must observe a landmark of the part; None
            = any of the part.
    """
    is_in = selection.as_mask(vertices, len(vi_map.vertices))
    observing = is_in if observed_by is None else selection.as_mask(observed_by, len(is_in)) & is_in
    keypoints = vi_map.observations
    keypoints = keypoints[observing[vi_map.keypoint_vertex[keypoints]]]
    landmarks = distinct(vi_map.keypoints.landmark[keypoints]).astype(np.int64)
    homeless = landmarks[~is_in[vi_map.landmarks.vertex[landmarks]]]
    store = vertex_removal.stores_for(vi_map, homeless, is_in, same_mission=False)
    moved = vertex_removal.move_landmarks(vi_map, homeless, store)
    rows = np.flatnonzero(is_in)
    missions = distinct(vi_map.vertices.mission[rows]).astype(np.int64)
    frames = np.flatnonzero(is_in[vi_map.frames.vertex])
    part = selection.keep_rows(moved, missions=missions, vertices=rows, landmarks=landmarks)
    if not np.array_equal(part.frames.id, vi_map.frames.id[frames]):  # frames out of order
        frames = frames[
            np.lexsort((vi_map.frames.camera_index[frames], vi_map.frames.vertex[frames]))
        ]
    return Excerpt(
        vi_map, part, missions, rows, landmarks, table.ragged_rows(vi_map.keypoint_start, frames)
    )


def cut_by_time(vi_map: VIMap, seconds: float) -> list[VIMap]:
    """Cut a map of one mission into submaps, as robots send them; neighbours share a vertex.

    A landmark that several submaps observe is in each of them, under the same id.

    Args:
        vi_map: The map, its vertices in the order of time.
        seconds: Length of a submap [s]; the last may be up to half as long again.
    """
    times_ns = vi_map.vertices.timestamp_ns
    count = max(1, round(1e-9 * float(times_ns[-1] - times_ns[0]) / seconds))
    limits = times_ns[0] + (times_ns[-1] - times_ns[0]) * np.arange(1, count) // count
    inner = np.searchsorted(times_ns, limits)
    cuts = np.unique(np.concatenate([[0], inner, [len(times_ns) - 1]]))
    parts = zip(cuts[:-1].tolist(), cuts[1:].tolist(), strict=True)
    return [excerpt(vi_map, np.arange(first, last + 1)).vi_map for first, last in parts]


def mission_maps(vi_map: VIMap) -> list[VIMap]:
    """Return a map of each mission with vertices."""
    masks = (vi_map.vertices.mission == mission for mission in range(len(vi_map.missions)))
    return [excerpt(vi_map, mask).vi_map for mask in masks if mask.any()]


def with_ids_of_times(vi_map: VIMap, mission: str) -> VIMap:
    """Return a map of one mission whose ids follow from its name and the times of vertices and frames.

    So the copies of a vertex in two submaps have one id, and all submaps have the mission's. Landmarks get
    ids of their own in every submap; those of a shared vertex are united when submaps are joined.
    """
    v, frames, edges = vi_map.vertices, vi_map.frames, vi_map.imu_edges
    of_edges = v.timestamp_ns[edges.from_vertex]
    present = (frames.id != 0).any(axis=1)[:, None]
    camera = frames.camera_index.astype(np.int64)
    vertices = v.replace(
        id=_ids(f"vertex {mission}", v.timestamp_ns),
        nframe_id=_ids(f"nframe {mission}", v.timestamp_ns),
    )
    frame_ids = _ids(f"frame {mission}", v.timestamp_ns[frames.vertex], camera)
    first = v.timestamp_ns[:1]
    landmarks = vi_map.landmarks
    count = np.arange(len(landmarks), dtype=np.int64)
    landmark_ids = _ids(f"landmark {mission} {int(first[0])}", count)
    zero = np.zeros(1, dtype=np.int64)
    return vi_map.replace(
        missions=vi_map.missions.replace(id=_ids(f"mission {mission}", zero)),
        baseframes=vi_map.baseframes.replace(id=_ids(f"baseframe {mission}", zero)),
        vertices=vertices,
        frames=frames.replace(id=np.where(present, frame_ids, frames.id)),
        imu_edges=edges.replace(id=_ids(f"edge {mission}", of_edges)),
        landmarks=landmarks.replace(id=landmark_ids),
    )


def _ids(purpose: str, *numbers: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> ids.IdArray:
    """Return ids (N, 2) that follow from a text and some numbers (N,) each."""
    seed = np.frombuffer(hashlib.blake2b(purpose.encode(), digest_size=16).digest(), dtype="<u8")
    with np.errstate(over="ignore"):
        words = np.tile(seed.astype(np.uint64), (len(numbers[0]), 1))
        for column in numbers:
            words = _mix(words + column.astype(np.uint64)[:, None])
    return np.asarray(words | (words == 0).astype(np.uint64))


def _mix(words: ids.IdArray) -> ids.IdArray:
    """Return words whose every bit depends on all bits (the finaliser of splitmix64)."""
    words = (words ^ (words >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    words = (words ^ (words >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(words ^ (words >> np.uint64(31)))
