"""Rays of keypoints in the body frame, and the angle that a pixel covers."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from maplab_py.algorithms.landmarks.sightings import cameras_of
from maplab_py.array_types import F64, I64, Mask
from maplab_py.geometry import se3, so3, symmetric
from maplab_py.sensors import Camera, Projection
from maplab_py.sensors.camera import Distortion
from maplab_py.sensors.projection import back_project
from maplab_py.vimap import VIMap, ragged_rows
from maplab_py.vision.point_covariance import covariance_by_rays

_TILE_PX = 4.0
_TILES = 1 << 20  # larger than the height of an image
_TILES_PER_KEYPOINT = 4
_FARTHEST_PX = 1e6  # no image is larger: tiles keep within `_TILES`
"""With more keypoints all tiles of an image are computed, and kept for the next time."""
_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


def keypoint_rays(vi_map: VIMap, keypoints: I64) -> tuple[F64, F64, F64, Mask]:
    """Return camera centres and rays in I, the angle of a pixel [rad], and which rays exist."""
    origin, ray = np.zeros((len(keypoints), 3)), np.zeros((len(keypoints), 3))
    rad_per_px, valid = np.ones(len(keypoints)), np.zeros(len(keypoints), dtype=np.bool_)
    for camera, T_I_C, rows in cameras_of(vi_map, keypoints):
        bearing, rad_per_px[rows], valid[rows] = bearings(
            camera, vi_map.keypoints.uv_px[keypoints[rows]]
        )
        origin[rows], ray[rows] = T_I_C[4:], so3.rotate(T_I_C[:4], bearing)
    return origin, ray, rad_per_px, valid


def bearings(camera: Camera, uv: F64) -> tuple[F64, F64, Mask]:
    """Return unit rays in C, the angle that one pixel covers (geometric mean), and validity.

    The angle hardly changes from pixel to pixel: it is that of the middle of a small tile.
    """
    near = np.clip(np.nan_to_num(uv), -_FARTHEST_PX, _FARTHEST_PX)
    tile = np.floor(near / _TILE_PX).astype(np.int64)
    shape = (np.array([camera.width_px, camera.height_px]) / _TILE_PX).astype(np.int64) + 1
    rays, is_ray = back_project(camera, uv)
    if _TILES_PER_KEYPOINT * len(uv) >= shape.prod() and ((tile >= 0) & (tile < shape)).all():
        angle, is_sound = _angles_of_image(
            camera.projection, camera.distortion, camera.intrinsics.tobytes(),
            camera.distortion_parameters.tobytes(), *shape.tolist(),
        )  # fmt: skip
        of_keypoint = tile @ np.array([shape[1], 1])
    else:
        first = tile.min(axis=0, initial=0)
        key = (tile - first) @ np.array([_TILES, 1])
        key, of_keypoint = np.unique(key, return_inverse=True)
        angle, is_sound = _angles(camera, np.stack(np.divmod(key, _TILES), axis=1) + first)
    return rays, angle[of_keypoint], is_ray & is_sound[of_keypoint]


@lru_cache(maxsize=16)
def _angles_of_image(
    projection: Projection,
    distortion: Distortion,
    intrinsics: bytes,
    parameters: bytes,
    columns: int,
    rows: int,
) -> tuple[F64, Mask]:
    """Return `_angles` of all tiles of an image, column after column; many keypoints share them."""
    camera = Camera(
        "", projection, distortion, np.frombuffer(intrinsics), np.frombuffer(parameters), 0, 0
    )
    tiles = np.stack(np.divmod(np.arange(columns * rows), rows), axis=1)
    return _angles(camera, tiles)


def _angles(camera: Camera, tiles: I64) -> tuple[F64, Mask]:
    """Return the angles that a pixel covers in the middle of tiles (N, 2), and which are known."""
    middle = (tiles + 0.5) * _TILE_PX
    corners = np.concatenate([middle + offset for offset in _CORNERS])
    rays, is_ray = back_project(camera, corners)
    ray, right, below = rays.reshape(3, -1, 3)
    area = np.linalg.norm(np.cross(right - ray, below - ray), axis=1)
    is_sound = is_ray.reshape(3, -1).all(axis=0) & (area > 0.0)
    return np.sqrt(np.where(is_sound, area, 1.0)), is_sound


def landmark_covariance(vi_map: VIMap, landmarks: I64, sigma_px: ArrayLike) -> F64:
    """Return the covariances (N, 3, 3) of landmarks in G from their keypoints; poses are exact.

    Landmarks without rays (lidar) have unknown position.

    Args:
        landmarks: Landmark rows (N,).
        sigma_px: Standard deviation of keypoints: of all, or (K,) of each keypoint of the map.
    """
    keypoints = vi_map.observations[ragged_rows(vi_map.observation_start, landmarks)]
    owner = np.repeat(np.arange(len(landmarks)), np.diff(vi_map.observation_start)[landmarks])
    origin_I, _, rad_per_px, seen = keypoint_rays(vi_map, keypoints)
    centre_G = se3.transform(vi_map.T_G_I[vi_map.keypoint_vertex[keypoints]], origin_I)
    to_point_G = vi_map.p_G[landmarks][owner] - centre_G
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(vi_map.keypoints))
    sigma_rad = sigma[keypoints] * rad_per_px
    return covariance_by_rays(to_point_G, sigma_rad, seen, owner, len(landmarks))


def largest_sigma(covariance: F64) -> F64:
    """Return the standard deviation (N,) along the worst axis of covariances (N, 3, 3)."""
    if not len(covariance):
        return np.zeros(0)
    return np.asarray(np.sqrt(np.maximum(symmetric.eigen(covariance)[0][:, -1], 0.0)))
