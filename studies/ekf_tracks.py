"""Feature tracks for a filter: bearings with the noise of their pixels, without landmarks.

A track consists of the observations of a landmark by one camera in consecutive images. Later
observations of the same landmark are another track: a filter does not store landmarks.
"""

import dataclasses

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project, project
from maplab_py.vimap import VIMap, ragged_rows, starts_of_counts

_LONGEST_GAP = 2
"""Largest number of vertices from one observation of a track to the next."""
_GAUSS_NEWTON_STEPS = 3
_NEAREST_M = 0.1


@dataclasses.dataclass(frozen=True, eq=False)
class Tracks:
    """T tracks of O observations, grouped by track and sorted by time within a track."""

    start: I64  # (T + 1,) offsets
    camera: I64  # (T,)
    vertex: I64  # (O,) rows
    ray_C: F64  # (O, 3) unit bearing
    whitening: F64  # (O, 2, 3) from errors of the bearing to whitened pixels

    @property
    def end(self) -> I64:
        """Vertex (T,) of the last observation of every track."""
        return np.asarray(self.vertex[self.start[1:] - 1])


def tracks_of(vi_map: VIMap, vertices: I64, cameras: tuple[Camera, ...], longest: int) -> Tracks:
    """Return the tracks with at least three images of vertices (rows, ascending) of one mission.

    Args:
        vi_map: The map; its landmarks tell which keypoints belong together.
        vertices: Vertex rows.
        cameras: Cameras of the mission's rig.
        longest: Tracks that span more vertices are split.
    """
    keypoints = vi_map.keypoints
    inside = np.zeros(len(vi_map.vertices), dtype=np.bool_)
    inside[vertices] = True
    rows = np.flatnonzero((keypoints.landmark >= 0) & inside[vi_map.keypoint_vertex])
    vertex = vi_map.keypoint_vertex[rows].astype(np.int64)
    landmark = keypoints.landmark[rows].astype(np.int64)
    camera = vi_map.frames.camera_index[vi_map.keypoint_frame[rows]].astype(np.int64)
    order = np.lexsort((vertex, camera, landmark))
    rows, vertex, landmark, camera = rows[order], vertex[order], landmark[order], camera[order]
    same = (landmark[1:] == landmark[:-1]) & (camera[1:] == camera[:-1])
    step = np.diff(vertex)
    keep = np.concatenate([[True], ~(same & (step == 0))])  # one keypoint an image
    begins = np.concatenate([[True], ~same | (step > _LONGEST_GAP)])
    track = np.cumsum(begins) - 1
    age = vertex - vertex[np.flatnonzero(begins)][track]
    track = np.unique(track * (len(vi_map.vertices) + 1) + age // longest, return_inverse=True)[1]
    ray, whitening, valid = _bearings(vi_map, rows, camera, cameras)
    keep &= valid
    count = np.bincount(track[keep], minlength=int(track.max(initial=-1)) + 1)
    keep &= count[track] >= 3
    kept = np.unique(track[keep], return_index=True, return_counts=True)
    first = np.flatnonzero(keep)[kept[1]]
    return Tracks(
        starts_of_counts(kept[2]), camera[first], vertex[keep], ray[keep], whitening[keep]
    )


def _bearings(
    vi_map: VIMap, rows: I64, camera: I64, cameras: tuple[Camera, ...]
) -> tuple[F64, F64, Mask]:
    """Return rays (O, 3), their whitening (O, 2, 3) and whether they are valid."""
    ray, whitening = np.zeros((len(rows), 3)), np.zeros((len(rows), 2, 3))
    valid = np.zeros(len(rows), dtype=np.bool_)
    for number, model in enumerate(cameras):
        rows_of_camera = np.flatnonzero(camera == number)
        bearing, exists = back_project(model, vi_map.keypoints.uv_px[rows[rows_of_camera]])
        _, visible = project(model, bearing)
        sigma = np.maximum(vi_map.keypoints.sigma_px[rows[rows_of_camera]], 1e-3)
        ray[rows_of_camera], valid[rows_of_camera] = bearing, exists & visible
        whitening[rows_of_camera] = pixel_slopes(model, bearing) / sigma[:, None, None]
    return ray, whitening, valid


def pixel_slopes(camera: Camera, p_C: F64) -> F64:
    """Return the derivatives (N, 2, 3) of pixels by points (N, 3), by differences of fourth order."""
    steps = 1e-3 * np.eye(3)
    near, far = (
        np.stack(
            [project(camera, p_C + k * d)[0] - project(camera, p_C - k * d)[0] for d in steps],
            axis=-1,
        )
        for k in (1, 2)
    )
    return np.asarray((8.0 * near - far) / 12e-3)


@dataclasses.dataclass(frozen=True, eq=False)
class TrackResiduals:
    """Whitened errors of the observations of some tracks, and their Jacobians."""

    vertex: I64  # (n,) rows
    camera: I64  # (n,)
    track: I64  # (n,) counted from 0
    residual: F64  # (n, 2) measured less predicted
    by_pose: F64  # (n, 2, 6) position of I in G, orientation (right)
    by_camera: F64  # (n, 2, 6) position of C in I, orientation (right)
    by_point: F64  # (n, 2, 3)
    is_good: Mask  # tracks: triangulated in front of all cameras


def linearised(
    tracks: Tracks,
    chosen: I64,
    T_G_I: F64,
    T_I_C: F64,
    first_T_G_I: F64,
    min_parallax_rad: float = 0.0,
) -> TrackResiduals:
    """Triangulate tracks and return their residuals.

    Args:
        chosen: Rows (n,) of the tracks.
        T_G_I: Current poses (V, 7) of all vertices.
        T_I_C: Current poses (C, 7) of the cameras on the IMU.
        first_T_G_I: Poses (V, 7) at which Jacobians are evaluated.
        min_parallax_rad: Tracks with less parallax are rejected.
    """
    rows = ragged_rows(tracks.start, chosen)
    count = np.diff(tracks.start)[chosen]
    track = np.repeat(np.arange(len(chosen)), count)
    camera = tracks.camera[chosen][track]
    vertex, ray_C, whitening = tracks.vertex[rows], tracks.ray_C[rows], tracks.whitening[rows]
    R_G_I, R_I_C = so3.to_matrix(T_G_I[vertex, :4]), so3.to_matrix(T_I_C[camera, :4])
    p_I, p_C = T_G_I[vertex, 4:], T_I_C[camera, 4:]
    R_C_G = np.einsum("nji,nkj->nik", R_I_C, R_G_I)
    origin = p_I + np.einsum("nij,nj->ni", R_G_I, p_C)
    ray_G = np.einsum("nji,nj->ni", R_C_G, ray_C)
    point, met = _meet(origin, ray_G, track, count, min_parallax_rad)
    for _ in range(_GAUSS_NEWTON_STEPS):
        y_C = np.einsum("nij,nj->ni", R_C_G, point[track] - origin)
        error, slope = _errors(y_C, ray_C, whitening)
        point = point + _landmark_step(error, slope @ R_C_G, track, len(chosen))
    y_C = np.einsum("nij,nj->ni", R_C_G, point[track] - origin)
    error, _ = _errors(y_C, ray_C, whitening)
    ahead = np.einsum("ni,ni->n", y_C, ray_C) > _NEAREST_M
    good = met & (np.bincount(track, ~ahead, minlength=len(chosen)) == 0)
    # Jacobians at the first estimates of the poses, so that heading stays unobservable
    R_first = so3.to_matrix(first_T_G_I[vertex, :4])
    y_I = np.einsum("nji,nj->ni", R_first, point[track] - first_T_G_I[vertex, 4:])
    y_C = np.einsum("nji,nj->ni", R_I_C, y_I - p_C)
    _, slope = _errors(y_C, ray_C, whitening)
    by_I = slope @ R_I_C.transpose(0, 2, 1)  # d / d y_I
    by_point = by_I @ R_first.transpose(0, 2, 1)
    by_pose = np.concatenate([-by_point, by_I @ so3.skew(y_I)], axis=2)
    by_camera = np.concatenate([-by_I, slope @ so3.skew(y_C)], axis=2)
    return TrackResiduals(vertex, camera, track, error, by_pose, by_camera, by_point, good)


def _meet(
    origin: F64, ray_G: F64, track: I64, length: I64, min_parallax_rad: float
) -> tuple[F64, Mask]:
    """Return the point (T, 3) nearest to the rays of every track, and whether it exists.

    The smallest eigenvalue is that of the sum of the rays' squared deviations from their mean;
    rays that spread evenly over an angle have a twelfth of its square each.
    """
    across = np.eye(3) - ray_G[:, :, None] * ray_G[:, None, :]
    normal = _sum(across, track, len(length))
    right = _sum(np.einsum("nij,nj->ni", across, origin), track, len(length))
    spread = np.linalg.eigvalsh(normal)[:, 0] / length
    met = spread > max(min_parallax_rad**2 / 12.0, 1e-8)
    normal[~met] = np.eye(3)
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0]), met


def _errors(y_C: F64, ray_C: F64, whitening: F64) -> tuple[F64, F64]:
    """Return whitened errors (n, 2), measured less predicted, and d prediction / d y_C (n, 2, 3)."""
    distance = np.maximum(np.linalg.norm(y_C, axis=1), 1e-6)[:, None]
    predicted = y_C / distance
    across = np.eye(3) - predicted[:, :, None] * predicted[:, None, :]
    slope = whitening @ across / distance[:, :, None]
    return np.einsum("nij,nj->ni", whitening, ray_C - predicted), slope


def _landmark_step(error: F64, by_point: F64, track: I64, count: int) -> F64:
    normal = _sum(np.einsum("nki,nkj->nij", by_point, by_point), track, count)
    right = _sum(np.einsum("nki,nk->ni", by_point, error), track, count)
    damping = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] + 1e-9
    return np.asarray(np.linalg.solve(normal + damping * np.eye(3), right[:, :, None])[:, :, 0])


def _sum(values: F64, track: I64, count: int) -> F64:
    """Sum (n, ...) by track."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, track, values)
    return total
