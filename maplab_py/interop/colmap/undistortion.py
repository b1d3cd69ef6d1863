"""Perspective cameras in place of distorted ones, for exports."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import I64
from maplab_py.sensors import Camera, CameraRig, SensorSet
from maplab_py.sensors.camera import Distortion, Projection
from maplab_py.sensors.projection import back_project
from maplab_py.vimap import MissionSensor, VIMap
from maplab_py.vimap.queries import mission_sensor_id

_MIN_Z = 0.1
"""Least z of a unit ray that a perspective camera sees: 84 degrees from its axis."""


def undistorted(vi_map: VIMap, missions: I64) -> tuple[VIMap, int]:
    """Return the map with perspective cameras and keypoints in missions (rows).

    The focal length is that of the image's centre. Keypoints that a perspective camera cannot see are
    no longer observations; their place has no meaning.

    Returns:
        The map, and the number of observations that were lost.
    """
    uv = vi_map.keypoints.uv_px.copy()
    landmark = vi_map.keypoints.landmark.copy()
    frame = vi_map.keypoint_frame
    mission = vi_map.vertices.mission[vi_map.frames.vertex[frame]]
    camera_index = vi_map.frames.camera_index[frame]
    sensors = dict(vi_map.sensors.sensors)
    rig_ids = {
        rig_id: np.array([m for m in missions.tolist() if _rig_id(vi_map, m) == rig_id])
        for rig_id in dict.fromkeys(_rig_id(vi_map, m) for m in missions.tolist())
        if rig_id
    }
    lost = 0
    for rig_id, rows in rig_ids.items():
        rig = vi_map.sensors.camera_rig(rig_id)
        cameras = tuple(perspective(camera) for camera in rig.cameras)
        sensors[rig_id] = dataclasses.replace(rig, cameras=cameras)
        for index, (camera, new) in enumerate(zip(rig.cameras, cameras, strict=True)):
            mine = np.flatnonzero(np.isin(mission, rows) & (camera_index == index))
            ray, valid = back_project(camera, uv[mine])
            seen = valid & (ray[:, 2] > _MIN_Z)
            z = np.where(seen, ray[:, 2], 1.0)
            pixels = new.intrinsics[:2] * ray[:, :2] / z[:, None] + new.intrinsics[2:]
            uv[mine] = np.where(seen[:, None], pixels, -1.0)
            lost += int(np.count_nonzero(landmark[mine[~seen]] >= 0))
            landmark[mine[~seen]] = -1
    return vi_map.replace(
        sensors=SensorSet(sensors, vi_map.sensors.extrinsics, vi_map.sensors.extra),
        keypoints=vi_map.keypoints.replace(uv_px=uv, landmark=landmark),
    ), lost


def perspective(camera: Camera) -> Camera:
    """Return the perspective camera on the same axis, with the resolution of the image's centre."""
    return dataclasses.replace(
        camera,
        projection=Projection.PINHOLE,
        distortion=Distortion.NONE,
        intrinsics=np.concatenate([camera.central_focal_px, camera.intrinsics[-2:]]),
        distortion_parameters=np.zeros(0),
    )


def _rig_id(vi_map: VIMap, mission: int) -> str:
    rig_id = mission_sensor_id(vi_map, mission, MissionSensor.NCAMERA)
    return rig_id if isinstance(vi_map.sensors.sensors.get(rig_id), CameraRig) else ""
