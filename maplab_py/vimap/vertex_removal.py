"""Remove vertices of missions: edges are joined, landmarks move to other store vertices."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import I64, Mask
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.vimap.edge_joining import join_imu_edges, join_transformation_edges
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.selection import as_mask, keep_rows
from maplab_py.vimap.vi_map import VIMap


@dataclasses.dataclass(frozen=True)
class VertexRemoval:
    """Data removed with vertices."""

    vertices: int
    observations: int
    landmarks_moved: int
    loop_closure_edges: int
    absolute_poses: int
    resources: int
    imu_edges_dropped: int  # between kept vertices, because a link had none
    transformation_edges_dropped: int


def remove_vertices(vi_map: VIMap, vertices: ArrayLike) -> VIMap:
    """Remove vertices (rows or a mask (V,)); see `remove_vertices_counted`."""
    return remove_vertices_counted(vi_map, vertices)[0]


def remove_vertices_counted(vi_map: VIMap, vertices: ArrayLike) -> tuple[VIMap, VertexRemoval]:
    """Remove vertices; also return the data removed with them.

    Between two kept neighbours the IMU edges are concatenated and relative-pose edges of one kind
    and sensor composed with their covariances; a kind that one link lacks is dropped there, as in
    maplab. Landmarks stored in a removed vertex move to their first kept observer of the mission,
    else to the nearest kept vertex, and keep their position in G. Observations, loop closure
    edges, absolute poses and resources of removed vertices are removed.

    Args:
        vi_map: The map.
        vertices: Vertex rows or a mask (V,).

    Raises:
        UserError: A mission would lose all its vertices.
    """
    removed = as_mask(vertices, len(vi_map.vertices))
    kept_per_mission = np.bincount(
        vi_map.vertices.mission[~removed], minlength=len(vi_map.missions)
    )
    emptied = np.flatnonzero((kept_per_mission == 0) & (np.diff(vi_map.vertex_start) > 0))
    if len(emptied):
        raise UserError(
            f"cannot remove all vertices of mission {to_hex(vi_map.missions.id[emptied[0]])}: "
            "remove the mission"
        )
    homeless = np.flatnonzero(removed[vi_map.landmarks.vertex])
    store = stores_for(vi_map, homeless, ~removed, same_mission=True)
    joined = move_landmarks(vi_map, homeless, store)
    joined, imu_dropped = join_imu_edges(joined, ~removed)
    joined, transformation_dropped = join_transformation_edges(joined, ~removed)
    result = keep_rows(joined, vertices=np.flatnonzero(~removed))
    report = VertexRemoval(
        vertices=int(removed.sum()),
        observations=len(vi_map.observations) - len(result.observations),
        landmarks_moved=len(homeless),
        loop_closure_edges=len(vi_map.loop_closure_edges) - len(result.loop_closure_edges),
        absolute_poses=len(vi_map.absolute_poses) - len(result.absolute_poses),
        resources=len(vi_map.resources) - len(result.resources),
        imu_edges_dropped=imu_dropped,
        transformation_edges_dropped=transformation_dropped,
    )
    return result, report


def stores_for(vi_map: VIMap, landmarks: I64, vertex_kept: Mask, *, same_mission: bool) -> I64:
    """Return a kept vertex (N,) for each landmark: its first kept observer.

    Args:
        vi_map: The map.
        landmarks: Landmark rows (N,).
        vertex_kept: Vertices (V,) that may store them.
        same_mission: Use an observer of the landmark's mission, else its nearest kept vertex
            (every mission must have one); otherwise return -1 without observer.
    """
    mission = vi_map.vertices.mission
    home = mission[vi_map.landmarks.vertex]
    keypoints = vi_map.observations
    observed = vi_map.keypoints.landmark[keypoints]
    observer = vi_map.keypoint_vertex[keypoints]
    usable = vertex_kept[observer]
    if same_mission:
        usable &= mission[observer] == home[observed]
    first = np.full(len(vi_map.landmarks), -1, dtype=np.int64)
    first[observed[usable][::-1]] = observer[usable][::-1]
    store = first[landmarks]
    if same_mission:
        lost = np.flatnonzero(store < 0)
        store[lost] = _nearest_kept(vi_map, vi_map.landmarks.vertex[landmarks[lost]], vertex_kept)
    return store


def _nearest_kept(vi_map: VIMap, vertices: NDArray[np.int32], vertex_kept: Mask) -> I64:
    """Return the kept vertex of the same mission that is nearest along the graph."""
    kept = np.flatnonzero(vertex_kept)
    after = np.searchsorted(kept, vertices)
    before = np.clip(after - 1, 0, max(len(kept) - 1, 0))
    after = np.clip(after, 0, max(len(kept) - 1, 0))
    mission = vi_map.vertices.mission
    fits_before = mission[kept[before]] == mission[vertices]
    fits_after = mission[kept[after]] == mission[vertices]
    nearer_before = np.abs(kept[before] - vertices) <= np.abs(kept[after] - vertices)
    take_before = fits_before & (nearer_before | ~fits_after)
    return np.asarray(np.where(take_before, kept[before], kept[after]))


def move_landmarks(vi_map: VIMap, landmarks: I64, vertices: I64) -> VIMap:
    """Store landmarks (N,) in other vertices (N,) without moving them in G."""
    if len(landmarks) == 0:
        return vi_map
    table = vi_map.landmarks
    T_N_O = se3.relative(vi_map.T_G_I[vertices], vi_map.T_G_I[table.vertex[landmarks]])
    R_N_O = so3.to_matrix(T_N_O[:, :4])
    store, p_I, covariance = table.vertex.copy(), table.p_I.copy(), table.covariance.copy()
    store[landmarks] = vertices
    p_I[landmarks] = se3.transform(T_N_O, p_I[landmarks])
    covariance[landmarks] = R_N_O @ covariance[landmarks] @ R_N_O.transpose(0, 2, 1)
    return vi_map.replace(landmarks=table.replace(vertex=store, p_I=p_I, covariance=covariance))
