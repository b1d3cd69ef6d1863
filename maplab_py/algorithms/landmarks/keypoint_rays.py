"""Rays of keypoints in the body frame, and the angle that a pixel covers."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import F64, I64, Mask
from maplab_py.distinct import distinct
from maplab_py.geometry import so3
from maplab_py.sensors import Camera
from maplab_py.sensors.projection import back_project
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.ids import to_hex

_TILE_PX = 4.0
_TILES = 1 << 20  # larger than the height of an image
_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
_SENSORS = [MissionSensor.IMU, MissionSensor.NCAMERA]


def keypoint_rays(vi_map: VIMap, keypoints: I64) -> tuple[F64, F64, F64, Mask]:
    """Return camera centres and rays in I, the angle of a pixel [rad], and which rays exist."""
    frame = vi_map.keypoint_frame[keypoints]
    rigs, rig_of_mission = np.unique(
        vi_map.missions.sensor_id[:, _SENSORS], axis=0, return_inverse=True
    )
    rig = rig_of_mission[vi_map.vertices.mission[vi_map.frames.vertex[frame]]]
    camera_index = vi_map.frames.camera_index[frame]
    origin, ray = np.zeros((len(keypoints), 3)), np.zeros((len(keypoints), 3))
    rad_per_px, valid = np.ones(len(keypoints)), np.zeros(len(keypoints), dtype=np.bool_)
    uv = vi_map.keypoints.uv_px[keypoints]
    for row in distinct(rig):
        imu, ncamera = map(to_hex, rigs[row])
        T_I_C = vi_map.sensors.T_I_C(imu, ncamera)
        for index, camera in enumerate(vi_map.sensors.camera_rig(ncamera).cameras):
            mine = np.flatnonzero((rig == row) & (camera_index == index))
            bearing, angle, ok = bearings(camera, uv[mine])
            origin[mine] = T_I_C[index, 4:]
            ray[mine] = so3.rotate(T_I_C[index, :4], bearing)
            rad_per_px[mine], valid[mine] = angle, ok
    return origin, ray, rad_per_px, valid


def bearings(camera: Camera, uv: F64) -> tuple[F64, F64, Mask]:
    """Return unit rays in C, the angle that one pixel covers (geometric mean), and validity.

    The angle hardly changes from pixel to pixel: it is that of the middle of a small tile.
    """
    tile = np.floor(np.nan_to_num(uv) / _TILE_PX).astype(np.int64)
    first = tile.min(axis=0, initial=0)
    key = (tile - first) @ np.array([_TILES, 1])
    key, of_keypoint = np.unique(key, return_inverse=True)
    middle = (np.stack(np.divmod(key, _TILES), axis=1) + first + 0.5) * _TILE_PX
    corners = (middle + offset for offset in _CORNERS)
    rays, is_ray = back_project(camera, np.concatenate([uv, *corners]))
    ray, right, below = rays[len(uv) :].reshape(3, -1, 3)
    area = np.linalg.norm(np.cross(right - ray, below - ray), axis=1)
    is_sound = is_ray[len(uv) :].reshape(3, -1).all(axis=0) & (area > 0.0)
    angle = np.sqrt(np.where(is_sound, area, 1.0))
    return rays[: len(uv)], angle[of_keypoint], is_ray[: len(uv)] & is_sound[of_keypoint]
