"""Select the vertices, landmarks and observations of a map that an optimisation uses."""

import dataclasses

import numpy as np

from maplab_py.algorithms.landmarks.sightings import rays_in_G
from maplab_py.algorithms.vi_optimization.options import DataOptions, RobustnessOptions
from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.distinct import distinct
from maplab_py.errors import MapError, UserError
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import Observations
from maplab_py.geometry import so3, triangulation
from maplab_py.memory import require_memory
from maplab_py.report import counted
from maplab_py.vimap import LandmarkQuality, VIMap, queries, table, to_hex, type_name, type_of_name

_PRIOR_SIGMA_M = 10.0
"""Standard deviation of a landmark before its first observation."""
_RAD_PER_PX = 2e-3
"""Angle of a pixel of an ordinary camera; only ratios of distances matter for the choice."""
_NEAR_VERTICES = 20
"""Vertices of a mission that are farther apart in it see a place again."""
_BYTES_PER_PAIR = 64


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """Number of observations left out by the limits."""

    over_limit: int = 0  # max_observations_per_landmark
    not_covisible: int = 0  # max_covisible_frames


def thinned(vi_map: VIMap, keypoints: I64, options: DataOptions) -> tuple[I64, LeftOut]:
    """Return the observations (keypoint rows) that the limits leave, in order.

    Args:
        keypoints: Observations (O,), grouped by landmark.

    Raises:
        NotEnoughMemory: The pairs of vertices that share landmarks do not fit.
    """
    if not (options.max_observations_per_landmark or options.max_covisible_frames):
        return keypoints, LeftOut()
    from maplab_py.estimation.kernels.observation_choice import Links, Sight, choose

    landmark = vi_map.keypoints.landmark[keypoints].astype(np.int64)
    vertex = vi_map.keypoint_vertex[keypoints].astype(np.int64)
    first = np.unique(landmark, return_index=True)[1]
    start = np.append(first, len(keypoints)).astype(np.int64)
    if options.max_covisible_frames:
        links = Links(*_links(vi_map, vertex, landmark, options.max_covisible_frames))
    else:
        none = np.zeros(0, dtype=np.int64)
        links = Links(np.zeros(1, dtype=np.int64), none)
    sight = Sight(start, vertex, *_rays(vi_map, keypoints, landmark))
    chosen = np.zeros(len(keypoints), dtype=np.bool_)
    count = np.zeros(len(vi_map.vertices), dtype=np.int64)
    limit = options.max_observations_per_landmark
    over_limit, not_linked = choose(sight, links, limit, _PRIOR_SIGMA_M**-2, chosen, count)
    return keypoints[chosen], LeftOut(int(over_limit), int(not_linked))


def _rays(vi_map: VIMap, keypoints: I64, landmark: I64) -> tuple[F64, F64]:
    """Return unit rays (O, 3) to the landmarks and the inverse variances (O,) across them."""
    origins, directions, _ = rays_in_G(vi_map, keypoints)
    toward = vi_map.p_G[landmark] - origins
    distance = np.linalg.norm(toward, axis=1)
    is_known = np.isfinite(distance) & (distance > 0.0)
    distance = np.where(is_known, distance, 1.0)
    directions = np.where(is_known[:, None], toward / distance[:, None], directions)
    sigma_px = np.maximum(vi_map.keypoints.sigma_px[keypoints], 1e-3)
    return np.ascontiguousarray(directions), 1.0 / np.square(sigma_px * _RAD_PER_PX * distance)


def _links(vi_map: VIMap, vertex: I64, landmark: I64, limit: int) -> tuple[I64, I64]:
    """Return for each vertex the vertices, at most `limit`, that it may share landmarks with (CSR).

    Pairs are taken by their rank: the pair that shares most landmarks of every two missions, and of
    places seen again in one mission, comes before the second of any; equal ranks by shared landmarks.
    Loops and other missions thus keep their part of the pairs.
    """
    from maplab_py.estimation.kernels.observation_choice import match_vertices

    a, b, shared = _covisible(vi_map, vertex, landmark)
    mission = vi_map.vertices.mission.astype(np.int64)
    is_again = (mission[a] == mission[b]) & (np.abs(a - b) > _NEAR_VERTICES)
    rank = np.maximum(
        _rank(a, 2 * mission[b] + is_again, shared), _rank(b, 2 * mission[a] + is_again, shared)
    )
    order = np.lexsort((b, a, -shared, rank))
    a, b = a[order], b[order]
    kept = np.zeros(len(a), dtype=np.bool_)
    match_vertices(a, b, limit, np.zeros(len(vi_map.vertices), dtype=np.int64), kept)
    ends = np.stack([np.concatenate([a[kept], b[kept]]), np.concatenate([b[kept], a[kept]])])
    ends = ends[:, np.lexsort((ends[1], ends[0]))]
    return table.starts_of_counts(np.bincount(ends[0], minlength=len(vi_map.vertices))), ends[1]


def _covisible(vi_map: VIMap, vertex: I64, landmark: I64) -> tuple[I64, I64, I64]:
    """Return pairs of vertices (N,), the first the smaller row, and how many landmarks they share."""
    from scipy.sparse import triu

    pairs = float(np.sum(np.square(np.bincount(landmark).astype(np.float64))))
    largest = float(len(vi_map.vertices)) ** 2
    require_memory(_BYTES_PER_PAIR * min(pairs, largest), "counting what vertices share")
    sees = queries.observation_matrix(vi_map, (vertex, landmark))
    shared = triu(sees @ sees.T, k=1).tocoo()
    a, b = (index.astype(np.int64) for index in shared.coords)
    return a, b, shared.data.astype(np.int64)


def _rank(vertex: I64, group: I64, shared: I64) -> I64:
    """Return the rank (N,) of each pair among those of its vertex and group, by shared landmarks."""
    order = np.lexsort((-shared, group, vertex))
    begins: Mask = np.ones(len(order), dtype=np.bool_)
    begins[1:] = (np.diff(vertex[order]) != 0) | (np.diff(group[order]) != 0)
    first = np.maximum.accumulate(np.where(begins, np.arange(len(order)), 0))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - first
    return rank


@dataclasses.dataclass(frozen=True, eq=False)
class Selection:
    """Vertices and landmarks of the problem: problem row -> map row, and back (-1 = not in it)."""

    vertices: I64
    landmarks: I64
    row_of_vertex: I64
    keypoints: I64  # (O,) keypoint rows of the observations
    left_out: LeftOut = LeftOut()

    def rows(self, map_vertices: NDArray[np.integer]) -> I64:
        """Return the problem rows of map vertices."""
        return np.asarray(self.row_of_vertex[map_vertices])


def select(vi_map: VIMap, options: DataOptions, missions: NDArray[np.integer] | None) -> Selection:
    """Select the vertices of the missions, and the landmarks stored and observed there.

    Observations beyond the limits of the options are left out, see `thinning`.
    """
    is_in = queries.mission_mask(vi_map, missions)[vi_map.vertices.mission]
    vertices = np.flatnonzero(is_in)
    row_of_vertex = np.full(len(vi_map.vertices), -1, dtype=np.int64)
    row_of_vertex[vertices] = np.arange(len(vertices))
    wanted = is_in[vi_map.landmarks.vertex]
    if options.use_only_good_landmarks:
        wanted = wanted & (vi_map.landmarks.quality != LandmarkQuality.BAD)
    if options.feature_type and options.include_visual:
        wanted = wanted & _of_type(vi_map, type_of_name(options.feature_type))
    keypoints = vi_map.observations if options.include_visual else np.zeros(0, dtype=np.int64)
    keypoints = keypoints[wanted[vi_map.keypoints.landmark[keypoints]]]
    keypoints = keypoints[is_in[vi_map.keypoint_vertex[keypoints]]]
    frame = vi_map.keypoint_frame[keypoints]
    per_frame = np.bincount(frame, minlength=len(vi_map.frames))
    rich = (per_frame >= options.min_landmarks_per_frame) & vi_map.frames.is_valid
    keypoints, left_out = thinned(vi_map, keypoints[rich[frame]], options)
    landmarks = distinct(vi_map.keypoints.landmark[keypoints]).astype(np.int64)
    return Selection(vertices, landmarks, row_of_vertex, keypoints, left_out)


def _of_type(vi_map: VIMap, feature_type: int) -> Mask:
    """Return which landmarks (L,) have a feature type.

    Raises:
        UserError: None has it.
    """
    of_type = vi_map.landmarks.feature_type == feature_type
    if not of_type.any():
        types = distinct(vi_map.landmarks.feature_type).tolist()
        names = ", ".join(type_name(other) for other in types)
        raise UserError(
            f"--ba_feature_type={type_name(feature_type)}: the map has no landmarks of that type"
            + (f", only of {names}" if names else "")
        )
    return np.asarray(of_type)


def check_finite(vi_map: VIMap, selection: Selection, options: DataOptions) -> None:
    """Check that all states are finite.

    Raises:
        MapError: A pose, or with inertial terms a velocity or bias, is not finite.
    """
    names = ("T_M_I", "v_M", "gyro_bias", "accel_bias") if options.include_inertial else ("T_M_I",)
    for name in names:
        values = getattr(vi_map.vertices, name)[selection.vertices]
        bad = selection.vertices[~np.isfinite(values).all(axis=1)]
        if len(bad):
            others = f" (and of {counted(len(bad) - 1, 'other')})" if len(bad) > 1 else ""
            raise MapError(
                f"{name} of vertex {to_hex(vi_map.vertices.id[bad[0]])}{others} is not a number: "
                "remove the vertex or load an older map"
            )


def check_metric(vi_map: VIMap, selection: Selection, options: DataOptions) -> None:
    """Check that inertial terms can apply: scale and gravity of all missions are known.

    Raises:
        UserError: Those of a mission are arbitrary, as in a model of COLMAP.
    """
    if not options.include_inertial:
        return
    for mission in distinct(vi_map.vertices.mission[selection.vertices]).tolist():
        if not queries.is_metric(vi_map, mission):
            raise UserError(
                f"mission {to_hex(vi_map.missions.id[mission])}: its scale and gravity are arbitrary, so "
                "inertial terms cannot apply: import it with --align_to, or give --ba_include_inertial=false"
            )


def initial_states(vi_map: VIMap, selection: Selection) -> States:
    """Return the states of the selected vertices and landmarks in G.

    Landmarks that are not finite start at zero, where the outlier gate rejects them.
    """
    rows = selection.vertices
    q_G_M = vi_map.T_G_M[vi_map.vertices.mission[rows], :4]
    return States(
        T_G_I=np.ascontiguousarray(vi_map.T_G_I[rows]),
        v_G=so3.rotate(q_G_M, vi_map.vertices.v_M[rows]),
        gyro_bias=vi_map.vertices.gyro_bias[rows],
        accel_bias=vi_map.vertices.accel_bias[rows],
        p_G=np.nan_to_num(vi_map.p_G[selection.landmarks], nan=0.0, posinf=0.0, neginf=0.0),
    )


def observations(
    vi_map: VIMap, selection: Selection, options: RobustnessOptions, first_camera: I64
) -> tuple[Observations, F64]:
    """Return the observations, all active, and their sigmas [px].

    Args:
        selection: Selected vertices and landmarks.
        first_camera: (M,) row of each mission's first camera.
    """
    keypoints = selection.keypoints
    landmark = np.searchsorted(selection.landmarks, vi_map.keypoints.landmark[keypoints])
    vertex = vi_map.keypoint_vertex[keypoints]
    mission = vi_map.vertices.mission[vertex]
    home = vi_map.vertices.mission[vi_map.landmarks.vertex[vi_map.keypoints.landmark[keypoints]]]
    camera = first_camera[mission] + vi_map.frames.camera_index[vi_map.keypoint_frame[keypoints]]
    sigma = np.maximum(vi_map.keypoints.sigma_px[keypoints], 1e-3)
    scale = np.where(mission == home, options.loss_scale, options.loss_scale_other_mission)
    data = Observations(
        start=table.starts_of_counts(np.bincount(landmark, minlength=len(selection.landmarks))),
        vertex=selection.rows(vertex).astype(np.int32),
        camera=camera.astype(np.int32),
        uv_px=np.ascontiguousarray(vi_map.keypoints.uv_px[keypoints]),
        inverse_sigma=1.0 / sigma,
        loss_scale=scale,
    )
    return data, sigma


def retriangulated(
    vi_map: VIMap, selection: Selection, states: States, start: I64, landmarks: I64
) -> States:
    """Return the states with landmarks (problem rows) triangulated from the current poses.

    Landmarks whose rays do not intersect in front of all cameras are unchanged.
    """
    rows = table.ragged_rows(start, landmarks)
    origins, directions, valid = rays_in_G(vi_map, selection.keypoints[rows])
    ray_start = table.starts_of_counts(np.diff(start)[landmarks])
    points, ok, _ = triangulation.triangulate(origins, directions, ray_start)
    owner = np.repeat(np.arange(len(landmarks)), np.diff(ray_start))
    ahead = np.einsum("oi,oi->o", points[owner] - origins, directions) > 0.0
    ok = ok & (np.bincount(owner, ~(ahead & valid), minlength=len(landmarks)) == 0)
    p_G = states.p_G.copy()
    p_G[landmarks[ok]] = points[ok]
    return dataclasses.replace(states, p_G=p_G)
