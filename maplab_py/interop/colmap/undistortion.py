"""Perspective cameras and undistorted keypoints, of models to import and of maps to export."""

import dataclasses
from pathlib import Path

import numpy as np

from maplab_py.array_types import I64, Mask
from maplab_py.errors import UserError
from maplab_py.interop.colmap import pycolmap_files
from maplab_py.interop.colmap.model import MODELS, NO_POINT, ColmapModel, has_model
from maplab_py.sensors import Camera, CameraRig, SensorSet, projection
from maplab_py.sensors.camera import Distortion, Projection
from maplab_py.vimap import MissionSensor, VIMap, mission_sensor_id, ragged_rows

_PINHOLE = 1
_LARGEST_TANGENT = 10.0
"""Keypoints further from the axis than 84 degrees are not observations any more."""


def perspective_model(model: ColmapModel, folder: Path) -> ColmapModel:
    """Return the model of a folder with PINHOLE cameras and undistorted keypoints where maplab lacks a model.

    Raises:
        UserError: A camera is equirectangular.
        MapError: pycolmap fails.
    """
    images, cameras = model.images, list(model.cameras)
    uv, point = images.uv.copy(), images.point.copy()
    for row, camera in enumerate(model.cameras):
        if has_model(camera):
            continue
        if MODELS[camera.model].name == "EQUIRECTANGULAR":
            raise UserError(
                f"{folder}: camera {camera.id} is EQUIRECTANGULAR: no perspective image shows it"
            )
        # of SIMPLE_DIVISION the parameters are f cx cy k
        values = camera.parameters[[0, 0, 1, 2] if len(camera.parameters) == 4 else [0, 1, 2, 3]]
        cameras[row] = dataclasses.replace(camera, model=_PINHOLE, parameters=values)
        mine = ragged_rows(images.keypoint_start, np.flatnonzero(images.camera == row))
        rays = pycolmap_files.rays_of(camera, uv[mine])
        seen: Mask = np.asarray(np.isfinite(rays).all(axis=1))
        seen &= np.linalg.norm(np.where(seen[:, None], rays, 0.0), axis=1) < _LARGEST_TANGENT
        uv[mine] = np.where(seen[:, None], rays * values[:2] + values[2:], -1.0)
        point[mine[~seen]] = NO_POINT
    images = dataclasses.replace(images, uv=uv, point=point)
    return dataclasses.replace(model, cameras=tuple(cameras), images=images)


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
            ray, valid = projection.back_project(camera, uv[mine])
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
