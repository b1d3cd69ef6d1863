"""Observations as geometry: rays in G, points in camera frames, reprojection errors."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from maplab_py.array_types import F64, I64, Mask, NDArray
from maplab_py.geometry import se3, so3
from maplab_py.sensors import Camera, Projection, projection
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id

LIDAR_FEATURE_TYPES = (21,)
"""Feature types (proto values) whose keypoints carry a 3-D position."""


@dataclasses.dataclass(frozen=True, eq=False)
class Residuals:
    """Reprojection and depth of points at the keypoints that observe them."""

    error_px: F64  # (O,), infinite where the point does not project into the camera
    signed_distance_m: F64  # (O,), negative behind the camera
    error_m: F64  # (O,), lidar observations; NaN for all others


def cameras_of(vi_map: VIMap, keypoints: I64) -> Iterator[tuple[Camera, F64, I64]]:
    """Yield each mission's cameras with T_I_C (7,) and the indices into `keypoints` they measured.

    Raises:
        MapError: A mission's camera rig or IMU is not in sensors.yaml.
    """
    frame = vi_map.keypoint_frame[keypoints]
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]].astype(np.int64)
    index = vi_map.frames.camera_index[frame]
    key = mission * (int(index.max(initial=0)) + 1) + index
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    for rows in np.split(order, first[1:]) if len(order) else ():
        row = int(mission[rows[0]])
        rig_id = mission_sensor_id(vi_map, row, MissionSensor.NCAMERA)
        imu_id = mission_sensor_id(vi_map, row, MissionSensor.IMU)
        camera = int(index[rows[0]])
        T_I_C = vi_map.sensors.T_I_C(imu_id, rig_id)[camera]
        yield vi_map.sensors.camera_rig(rig_id).cameras[camera], T_I_C, rows


def _T_G_I(vi_map: VIMap, keypoints: I64, camera: Camera) -> F64:
    """Return the poses (O, 7) at the times of pixels of a camera."""
    vertex = vi_map.keypoint_vertex[keypoints]
    T_G_I = np.asarray(vi_map.T_G_I[vertex])
    if not camera.is_moving:
        return T_G_I
    from maplab_py.estimation.imu.inertial_data import motion_at_vertices

    q_G_M = vi_map.T_G_M[vi_map.vertices.mission[vertex], :4]
    v_G = so3.rotate(q_G_M, vi_map.vertices.v_M[vertex])
    delay_s = camera.delay_s(vi_map.keypoints.uv_px[keypoints])
    return motion_at_vertices(vi_map, vertex).of(vertex).after(delay_s, T_G_I, v_G)[0]


def is_lidar(vi_map: VIMap, landmarks: NDArray[np.integer]) -> Mask:
    """Return which landmarks (N,) are observed as 3-D points."""
    if vi_map.keypoints.position_3d.shape[1] != 3:
        return np.zeros(len(landmarks), dtype=np.bool_)
    return np.isin(vi_map.landmarks.feature_type[landmarks], LIDAR_FEATURE_TYPES)


def rays_in_G(vi_map: VIMap, keypoints: I64) -> tuple[F64, F64, Mask]:
    """Return camera centres (O, 3), unit rays (O, 3) in G, and which rays exist (O,).

    Cameras whose images have a delay, or a rolling shutter, are where they were at the time of the pixel.
    """
    origins, directions = np.zeros((len(keypoints), 3)), np.zeros((len(keypoints), 3))
    valid = np.zeros(len(keypoints), dtype=np.bool_)
    for camera, T_I_C, rows in cameras_of(vi_map, keypoints):
        T_G_C = se3.compose(_T_G_I(vi_map, keypoints[rows], camera), T_I_C)
        bearing, ok = projection.back_project(camera, vi_map.keypoints.uv_px[keypoints[rows]])
        origins[rows] = T_G_C[:, 4:]
        directions[rows] = so3.rotate(T_G_C[:, :4], bearing)
        valid[rows] = ok
    return origins, directions, valid


def residuals(vi_map: VIMap, keypoints: I64, p_G: F64) -> Residuals:
    """Compare points (O, 3) in G, one for each keypoint (O,), with the measurements."""
    error_px = np.full(len(keypoints), np.inf)
    distance, error_m = np.zeros(len(keypoints)), np.full(len(keypoints), np.nan)
    table = vi_map.keypoints
    lidar = np.zeros(len(keypoints), dtype=np.bool_)
    observing = table.landmark[keypoints] >= 0
    lidar[observing] = is_lidar(vi_map, table.landmark[keypoints[observing]])
    for camera, T_I_C, rows in cameras_of(vi_map, keypoints):
        camera_keypoints = keypoints[rows]
        T_G_C = se3.compose(_T_G_I(vi_map, camera_keypoints, camera), T_I_C)
        p_C = se3.transform(se3.inverse(T_G_C), p_G[rows])
        uv, visible = projection.project(camera, p_C)
        error = np.linalg.norm(uv - table.uv_px[camera_keypoints], axis=1)
        error_px[rows] = np.where(visible, error, np.inf)
        in_front = p_C[:, 2] > 0.0 if camera.projection is Projection.PINHOLE else visible
        with np.errstate(over="ignore"):  # infinite beyond 1e154 m
            distance[rows] = np.where(in_front, 1.0, -1.0) * np.linalg.norm(p_C, axis=1)
        points = rows[lidar[rows]]
        if len(points):
            measured = table.position_3d[keypoints[points]]
            error_m[points] = np.linalg.norm(p_C[lidar[rows]] - measured, axis=1)
            distance[points] = np.abs(distance[points])  # a lidar has a field of view of 360 deg
    return Residuals(error_px, distance, error_m)
