"""Select the vertices, landmarks and observations of a map that an optimisation uses."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from maplab_py.algorithms.landmarks.sightings import rays_in_G
from maplab_py.algorithms.vi_optimization.options import DataOptions, RobustnessOptions
from maplab_py.algorithms.vi_optimization.thinning import LeftOut, thinned
from maplab_py.array_types import F64, I64, Mask
from maplab_py.distinct import distinct
from maplab_py.errors import MapError, UserError
from maplab_py.estimation.states import States
from maplab_py.estimation.terms.visual import Observations
from maplab_py.geometry import so3
from maplab_py.geometry.triangulation import triangulate
from maplab_py.report import counted
from maplab_py.vimap import LandmarkQuality, VIMap
from maplab_py.vimap.descriptors import type_name, type_of_name
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.scale_marks import is_metric
from maplab_py.vimap.table import ragged_rows, starts_of_counts


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
    chosen = np.zeros(len(vi_map.missions), dtype=np.bool_)
    chosen[slice(None) if missions is None else missions] = True
    is_in = chosen[vi_map.vertices.mission]
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
        if not is_metric(vi_map, mission):
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
        vi_map: Map.
        selection: Selected vertices and landmarks.
        options: Scales of the loss.
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
        start=starts_of_counts(np.bincount(landmark, minlength=len(selection.landmarks))),
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
    rows = ragged_rows(start, landmarks)
    origins, directions, valid = rays_in_G(vi_map, selection.keypoints[rows])
    ray_start = starts_of_counts(np.diff(start)[landmarks])
    points, ok, _ = triangulate(origins, directions, ray_start)
    owner = np.repeat(np.arange(len(landmarks)), np.diff(ray_start))
    ahead = np.einsum("oi,oi->o", points[owner] - origins, directions) > 0.0
    ok = ok & (np.bincount(owner, ~(ahead & valid), minlength=len(landmarks)) == 0)
    p_G = states.p_G.copy()
    p_G[landmarks[ok]] = points[ok]
    return dataclasses.replace(states, p_G=p_G)
