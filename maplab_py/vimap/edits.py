"""Edits of a map: functions return a new map that shares all unchanged columns."""

import hashlib

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.geometry import se3, so3
from maplab_py.vimap.ids import IdArray, is_valid, random_ids
from maplab_py.vimap.selection import as_mask, as_rows, keep_rows
from maplab_py.vimap.table import connected_groups, object_column
from maplab_py.vimap.tables import NO_ROW, LandmarkQuality, Landmarks, ResourceOwner
from maplab_py.vimap.vertex_removal import move_landmarks, remove_vertices, stores_for
from maplab_py.vimap.vi_map import VIMap

__all__ = [
    "add_landmarks",
    "merge_landmarks",
    "remove_landmarks",
    "remove_loop_closure_edges",
    "remove_missions",
    "remove_observations",
    "remove_vertices",
    "transform_mission",
    "with_new_ids",
    "with_p_G",
]

TEXT_RESOURCE = 11
"""Number of the resource type of texts."""


def remove_missions(vi_map: VIMap, missions: ArrayLike) -> VIMap:
    """Remove missions with their vertices, edges, resources and landmarks.

    Landmarks that another mission observes are stored in their first observer there and keep their
    position in G. Loop closure edges to the removed missions are removed. Their texts, as the records of
    updates are, go to the newest mission that stays.

    Args:
        missions: Mission rows or a mask (M,).
    """
    removed = as_mask(missions, len(vi_map.missions))
    vi_map = with_texts_on_newest(vi_map, ~removed, of=removed)
    vertex_kept = ~removed[vi_map.vertices.mission]
    homeless = np.flatnonzero(~vertex_kept[vi_map.landmarks.vertex])
    store = stores_for(vi_map, homeless, vertex_kept, same_mission=False)
    stored = store >= 0
    vi_map = move_landmarks(vi_map, homeless[stored], store[stored])
    return keep_rows(vi_map, missions=np.flatnonzero(~removed))


def texts_of_missions(vi_map: VIMap) -> I64:
    """Return the resources (rows) that are texts of missions."""
    table = vi_map.resources
    return np.flatnonzero(
        (table.type == TEXT_RESOURCE) & (table.owner_kind == ResourceOwner.MISSION)
    )


def with_texts_on_newest(vi_map: VIMap, missions: Mask, of: Mask | None = None) -> VIMap:
    """Return the map with the texts of all missions, or of some (M,), on the newest of some missions (M,)."""
    rows = texts_of_missions(vi_map)
    rows = rows if of is None else rows[of[vi_map.resources.owner[rows]]]
    if len(rows) == 0 or not missions.any():
        return vi_map
    owner = newest_mission(vi_map, missions)
    return vi_map.replace(resources=vi_map.resources.put(rows, owner=owner))


def newest_mission(vi_map: VIMap, missions: Mask) -> int:
    """Return the row of the mission among some (M,) that begins last."""
    first = np.minimum(vi_map.vertex_start[:-1], max(len(vi_map.vertices) - 1, 0))
    chosen = np.flatnonzero(missions)
    return int(chosen[np.argmax(vi_map.vertices.timestamp_ns[first[chosen]])])


def remove_landmarks(vi_map: VIMap, landmarks: ArrayLike) -> VIMap:
    """Remove landmarks (rows or a mask (L,)); their keypoints stay without a landmark."""
    removed = as_mask(landmarks, len(vi_map.landmarks))
    return keep_rows(vi_map, landmarks=np.flatnonzero(~removed)) if removed.any() else vi_map


def remove_observations(vi_map: VIMap, keypoints: ArrayLike) -> VIMap:
    """Detach keypoints (rows or a mask (K,)) from their landmarks; the landmarks stay."""
    rows = as_rows(keypoints, len(vi_map.keypoints))
    return vi_map.replace(keypoints=vi_map.keypoints.put(rows, landmark=NO_ROW))


def remove_loop_closure_edges(vi_map: VIMap, edges: ArrayLike) -> VIMap:
    """Remove loop closure edges (rows or a mask)."""
    removed = as_mask(edges, len(vi_map.loop_closure_edges))
    return vi_map.replace(loop_closure_edges=vi_map.loop_closure_edges.take(~removed))


def merge_landmarks(vi_map: VIMap, from_rows: ArrayLike, into_rows: ArrayLike) -> VIMap:
    """Merge landmarks: observations of `from_rows[i]` become those of `into_rows[i]`.

    Pairs may form chains and trees: every connected component becomes one landmark, the
    lowest row that is never a source (the lowest of all in a cycle). It keeps its id, position and
    quality; the others are removed. If a frame would observe a merged landmark twice, the keypoint
    that observed the surviving landmark before is kept, else the one with the lowest row; the
    other keypoints are detached.

    Args:
        from_rows: Landmark rows (N,).
        into_rows: Landmark rows (N,).
    """
    source = np.asarray(from_rows, dtype=np.int64)
    target = np.asarray(into_rows, dtype=np.int64)
    if source.shape != target.shape:
        raise ValueError(f"{len(source)} landmarks cannot merge into {len(target)}")
    count = len(vi_map.landmarks)
    as_rows(np.concatenate([source, target]), count)  # range check
    survivor = survivors(source, target, count)
    absorbed = survivor != np.arange(count)
    if not absorbed.any():
        return vi_map
    before = vi_map.keypoints.landmark
    after = np.append(survivor, NO_ROW).astype(np.int32)[before]
    united = mask_of(count, survivor[absorbed])
    rows = np.flatnonzero((after >= 0) & united[after])
    frame = vi_map.keypoint_frame[rows]
    order = np.lexsort((rows, before[rows] != after[rows], frame, after[rows]))
    rows, frame = rows[order], frame[order]
    again = np.zeros(len(rows), dtype=np.bool_)
    again[1:] = (after[rows[1:]] == after[rows[:-1]]) & (frame[1:] == frame[:-1])
    after[rows[again]] = NO_ROW
    merged = vi_map.replace(keypoints=vi_map.keypoints.replace(landmark=after))
    return keep_rows(merged, landmarks=np.flatnonzero(~absorbed))


def survivors(source: I64, target: I64, count: int) -> I64:
    """Return the row (count,) that each landmark ends up in when `merge_landmarks` merges pairs (N,)."""
    label = connected_groups(source, target, count)
    is_source = mask_of(count, source[source != target])
    # the first of each group when sorted by (is a source, row)
    order = np.lexsort((np.arange(count), is_source, label))
    first = np.zeros(count, dtype=np.int64)
    first[label[order[::-1]]] = order[::-1]
    return np.asarray(first[label])


def add_landmarks(
    vi_map: VIMap,
    *,
    vertex: ArrayLike,
    p_I: ArrayLike,
    keypoint_rows: ArrayLike,
    keypoint_landmark: ArrayLike,
    ids: IdArray | None = None,
    quality: ArrayLike = LandmarkQuality.UNKNOWN,
    feature_type: ArrayLike = 0,
) -> VIMap:
    """Append landmarks and attach keypoints to them.

    Args:
        vertex: Store vertex (N,) of each new landmark.
        p_I: Position (N, 3) in the body frame of that vertex [m].
        keypoint_rows: Observing keypoints (O,); they are detached from their previous landmark.
        keypoint_landmark: For each of them (O,) the new landmark, 0 .. N - 1.
        ids: Ids (N, 2); by default derived from the map's content, so that equal maps get equal ids.
        quality: Quality of all or each (N,).
        feature_type: Feature type of all or each (N,).
    """
    store = np.asarray(vertex, dtype=np.int32)
    count = len(store)
    if ids is None:
        ids = random_ids(count, content_rng(vi_map, "landmarks"))
    table = Landmarks.filled(
        count,
        id=ids,
        vertex=store,
        p_I=p_I,
        quality=np.broadcast_to(np.asarray(quality, dtype=np.int8), (count,)),
        feature_type=np.broadcast_to(np.asarray(feature_type, dtype=np.int32), (count,)),
    )
    new_rows = len(vi_map.landmarks) + np.asarray(keypoint_landmark, dtype=np.int64)
    observing = np.asarray(keypoint_rows, dtype=np.int64)
    return vi_map.replace(
        landmarks=Landmarks.concatenate([vi_map.landmarks, table]),
        keypoints=vi_map.keypoints.put(observing, landmark=new_rows),
    )


def with_p_G(vi_map: VIMap, landmarks: ArrayLike, p_G: ArrayLike) -> VIMap:
    """Set the positions of landmarks (rows (N,)) to points (N, 3) in G; store vertices stay."""
    rows = np.asarray(landmarks, dtype=np.int64)
    T_I_G = se3.inverse(vi_map.T_G_I[vi_map.landmarks.vertex[rows]])
    p_I = se3.transform(T_I_G, p_G)
    return vi_map.replace(landmarks=vi_map.landmarks.put(rows, p_I=p_I))


def transform_mission(vi_map: VIMap, mission: int, T_N_M: F64) -> VIMap:
    """Transform a mission's states to another mission frame N (7,); its pose in G changes."""
    rows = vi_map.vertices.mission == mission
    v = vi_map.vertices
    T_M_I, v_M = se3.compose(T_N_M, v.T_M_I[rows]), so3.rotate(T_N_M[:4], v.v_M[rows])
    return vi_map.replace(vertices=v.put(rows, T_M_I=T_M_I, v_M=v_M))


def with_new_ids(vi_map: VIMap, rng: np.random.Generator | None = None) -> VIMap:
    """Assign new ids to missions, base frames, vertices, frames, landmarks and edges.

    Sensors and resources keep theirs (both name files or entries outside the tables); so does
    everything without an id. By default the ids are derived from the map's present ids: the same
    map gets the same new ids in every run, and different ones each time it is applied again.
    """
    if rng is None:
        rng = content_rng(vi_map, "new ids")

    def fresh(ids: IdArray) -> IdArray:
        return np.where(is_valid(ids)[:, None], random_ids(len(ids), rng), ids)

    names = (
        "missions",
        "baseframes",
        "vertices",
        "frames",
        "landmarks",
        "imu_edges",
        "transformation_edges",
        "loop_closure_edges",
    )
    tables = {name: getattr(vi_map, name) for name in names}
    tables = {name: table.replace(id=fresh(table.id)) for name, table in tables.items()}
    vertices = tables["vertices"]
    tables["vertices"] = vertices.replace(nframe_id=fresh(vertices.nframe_id))
    return vi_map.replace(**tables)


def content_rng(vi_map: VIMap, purpose: str, *others: VIMap) -> np.random.Generator:
    """Return a generator that depends on the ids of the maps and the purpose alone."""
    digest = hashlib.blake2b(purpose.encode(), digest_size=16)
    for source in (vi_map, *others):
        for table in (source.missions, source.vertices, source.landmarks):
            digest.update(np.ascontiguousarray(table.id, dtype="<u8").tobytes())
            digest.update(b"/")
    return np.random.default_rng(int.from_bytes(digest.digest(), "little"))


def remove_keypoints(vi_map: VIMap, removed: Mask) -> VIMap:
    """Return the map without some keypoints (K,) and their descriptors.

    Landmarks that lose their last observation are removed. Blocks that lose all keypoints are, too.
    """
    if not removed.any():
        return vi_map
    frames, keypoints = vi_map.frames, vi_map.keypoints
    before = np.concatenate([[0], np.cumsum(removed)])  # removed ones before each keypoint
    blocks = list(frames.descriptor_blocks)
    lost = np.diff(before[vi_map.keypoint_start])
    for row in np.flatnonzero(lost).tolist():
        end, kept = int(vi_map.keypoint_start[row]), []
        for block in blocks[row] or ():
            begin, end = end, end + block.keypoints
            count = block.keypoints - int(before[end] - before[begin])
            if count:
                kept.append(block._replace(keypoints=count))
        blocks[row] = tuple(kept) if blocks[row] is not None else None
    size = len(vi_map.landmarks)
    left = keypoints.landmark[~removed]
    observed = np.bincount(keypoints.landmark[keypoints.landmark >= 0], minlength=size)
    still = np.bincount(left[left >= 0], minlength=size)
    reduced = vi_map.replace(
        frames=frames.replace(
            keypoint_count=frames.keypoint_count - lost, descriptor_blocks=object_column(blocks)
        ),
        keypoints=keypoints.take(np.flatnonzero(~removed)),
    )
    return remove_landmarks(reduced, (observed > 0) & (still == 0))
