"""Remove vertices of missions: edges are joined, landmarks move to other store vertices."""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maplab_py.array_types import F64, I64, Mask, mask_of
from maplab_py.errors import UserError
from maplab_py.geometry import se3, so3
from maplab_py.vimap import ids, selection, tables
from maplab_py.vimap.table import ragged_rows, starts_of_counts
from maplab_py.vimap.vi_map import VIMap


@dataclasses.dataclass(frozen=True, eq=False)
class _Chains:
    """Edges along the graph between kept neighbours: chain i is edges[start[i] : start[i + 1]]."""

    edges: I64
    start: I64
    to_vertex: I64
    passed: Mask  # (E,) edges that stay as they are: both ends kept, not along the graph
    broken: int  # pairs of kept neighbours with some, but not all links


def join_imu_edges(vi_map: VIMap, vertex_kept: Mask) -> tuple[VIMap, int]:
    """Replace IMU edges by one edge between every two kept neighbours; also return the number lost.

    The sample at an inner boundary belongs to both edges and is kept once.
    """
    table = vi_map.imu_edges
    every = np.arange(len(table))
    chains = _chains(vi_map, table, every, vertex_kept)
    passed = np.flatnonzero(chains.passed)
    edges = np.concatenate([chains.edges, passed])
    counts = np.concatenate([np.diff(chains.start), np.ones(len(passed), dtype=np.int64)])
    start = starts_of_counts(counts)
    rows = ragged_rows(vi_map.sample_start, edges)
    of_edge = np.repeat(np.arange(len(edges)), table.sample_count[edges])
    of_chain = np.repeat(np.arange(len(counts)), counts)[of_edge]
    time = vi_map.imu_samples.timestamp_ns[rows]
    known = np.zeros(len(rows), dtype=np.bool_)
    known[1:] = (
        (of_chain[1:] == of_chain[:-1]) & (of_edge[1:] != of_edge[:-1]) & (time[1:] <= time[:-1])
    )
    joined = table.take(edges[start[:-1]]).replace(
        to_vertex=np.concatenate([chains.to_vertex, table.to_vertex[passed]]),
        sample_count=np.bincount(of_chain[~known], minlength=len(counts)),
    )
    samples = vi_map.imu_samples.take(rows[~known])
    return vi_map.replace(imu_edges=joined, imu_samples=samples), chains.broken


def join_transformation_edges(vi_map: VIMap, vertex_kept: Mask) -> tuple[VIMap, int]:
    """Compose relative-pose edges of one kind and sensor between kept neighbours.

    Returns:
        The map and the number of pairs of neighbours that lost their edge.
    """
    table = vi_map.transformation_edges
    if len(table) == 0:
        return vi_map, 0
    broken = 0
    parts = []
    keys = np.stack([table.kind.astype(np.uint64), *table.sensor_id.T], axis=1)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    for index in range(int(group.max()) + 1):
        chains = _chains(vi_map, table, np.flatnonzero(group == index), vertex_kept)
        broken += chains.broken
        parts += [_composed(table, chains), table.take(chains.passed)]
    joined = tables.TransformationEdges.concatenate(parts)
    joined = joined.take(
        np.lexsort((ids.as_keys(joined.id).argsort().argsort(), joined.from_vertex))
    )
    return vi_map.replace(transformation_edges=joined), broken


def _chains(
    vi_map: VIMap, table: tables.ImuEdges | tables.TransformationEdges, rows: I64, vertex_kept: Mask
) -> _Chains:
    """Find the edges `rows` of `table` that lie between kept neighbours of a mission."""
    count = len(vi_map.vertices)
    mission = vi_map.vertices.mission
    origin, end = table.from_vertex[rows], table.to_vertex[rows]
    is_link = (end == origin + 1) & (mission[end] == mission[origin])
    link = np.full(count, -1, dtype=np.int64)  # edge from vertex i to vertex i + 1
    link[origin[is_link][::-1]] = rows[is_link][::-1]
    chosen = mask_of(len(table), link[link >= 0])
    passed = np.zeros(len(table), dtype=np.bool_)
    passed[rows] = vertex_kept[origin] & vertex_kept[end]
    passed &= ~chosen

    kept = np.flatnonzero(vertex_kept)
    pair = mission[kept[1:]] == mission[kept[:-1]]
    first, last = kept[:-1][pair], kept[1:][pair]
    linked = starts_of_counts(link >= 0)
    links = linked[last] - linked[first]
    whole = links == last - first
    broken = int(np.count_nonzero(~whole & (links > 0)))
    first, last = first[whole], last[whole]
    start = starts_of_counts(last - first)
    inner = np.arange(start[-1]) + np.repeat(first - start[:-1], last - first)
    return _Chains(link[inner], start, last, passed, broken)


def _composed(table: tables.TransformationEdges, chains: _Chains) -> tables.TransformationEdges:
    """Compose the edges of each chain; all chains advance by one edge per round."""
    first = chains.edges[chains.start[:-1]]
    T, covariance = table.T_A_B[first].copy(), table.covariance[first].copy()
    length = np.diff(chains.start)
    for step in range(1, int(length.max(initial=0))):
        longer = np.flatnonzero(length > step)
        edge = chains.edges[chains.start[:-1][longer] + step]
        covariance[longer] = composed_covariance(
            T[longer], covariance[longer], table.T_A_B[edge], table.covariance[edge]
        )
        T[longer] = se3.compose(T[longer], table.T_A_B[edge])
    return table.take(first).replace(T_A_B=T, covariance=covariance, to_vertex=chains.to_vertex)


def composed_covariance(T_A_B: F64, cov_A_B: F64, T_B_C: F64, cov_B_C: F64) -> F64:
    """Return the covariance (N, 6, 6) of T_A_B T_B_C, position first, perturbed on the right.

    p_AC = p_AB + R_AB p_BC and R_AC = R_AB R_BC give
    dp = dp_1 + R_AB dp_2 - R_AB [p_BC]x dtheta_1,  dtheta = R_BC^T dtheta_1 + dtheta_2.
    """
    R_A_B, R_B_C = so3.to_matrix(T_A_B[:, :4]), so3.to_matrix(T_B_C[:, :4])
    first = np.zeros((len(T_A_B), 6, 6))
    first[:, :3, :3] = np.eye(3)
    first[:, :3, 3:] = -R_A_B @ so3.skew(T_B_C[:, 4:])
    first[:, 3:, 3:] = R_B_C.transpose(0, 2, 1)
    second = np.zeros((len(T_A_B), 6, 6))
    second[:, :3, :3] = R_A_B
    second[:, 3:, 3:] = np.eye(3)
    total = first @ cov_A_B @ first.transpose(0, 2, 1) + second @ cov_B_C @ second.transpose(
        0, 2, 1
    )
    return np.asarray(0.5 * (total + total.transpose(0, 2, 1)))


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
        vertices: Vertex rows or a mask (V,).

    Raises:
        UserError: A mission would lose all its vertices.
    """
    removed = selection.as_mask(vertices, len(vi_map.vertices))
    kept_per_mission = np.bincount(
        vi_map.vertices.mission[~removed], minlength=len(vi_map.missions)
    )
    emptied = np.flatnonzero((kept_per_mission == 0) & (np.diff(vi_map.vertex_start) > 0))
    if len(emptied):
        raise UserError(
            f"cannot remove all vertices of mission {ids.to_hex(vi_map.missions.id[emptied[0]])}: "
            "remove the mission"
        )
    homeless = np.flatnonzero(removed[vi_map.landmarks.vertex])
    store = stores_for(vi_map, homeless, ~removed, same_mission=True)
    joined = move_landmarks(vi_map, homeless, store)
    joined, imu_dropped = join_imu_edges(joined, ~removed)
    joined, transformation_dropped = join_transformation_edges(joined, ~removed)
    result = selection.keep_rows(joined, vertices=np.flatnonzero(~removed))
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
