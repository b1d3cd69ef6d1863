"""Perspective cameras in place of models that maplab lacks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from maplab_py.interop.colmap.camera_models import has_model
from maplab_py.interop.colmap.model import NO_POINT, ColmapCamera, ColmapModel
from maplab_py.vimap.table import ragged_rows, starts_of_counts

_PINHOLE = 1
_LARGEST_TANGENT = 10.0
"""Keypoints further from the axis than 84 degrees are not observations any more."""


def perspective_model(model: ColmapModel, work: Path, undistort: Callable[[], None]) -> ColmapModel:
    """Return the model with PINHOLE cameras and undistorted keypoints where maplab lacks a model.

    Args:
        model: Model.
        work: Folder of the job `undistort`, which runs on `pixels.npz` there.
        undistort: Runs the job.
    """
    images = model.images
    cameras = [camera for camera in model.cameras if not has_model(camera)]
    rows = [
        ragged_rows(images.keypoint_start, np.flatnonzero(images.camera == camera.id))
        for camera in cameras
    ]
    start = starts_of_counts(np.array([len(part) for part in rows]))
    chosen = np.concatenate(rows)
    numbers = np.array([camera.id for camera in cameras])
    np.savez(work / "pixels.npz", uv=images.uv[chosen], start=start, cameras=numbers)
    undistort()
    with np.load(work / "undistorted.npz", allow_pickle=False) as result:
        rays = result["rays"]
    new = {camera.id: _pinhole(camera) for camera in cameras}
    uv, point = images.uv.copy(), images.point.copy()
    seen = np.isfinite(rays).all(axis=1)
    seen &= np.linalg.norm(np.where(seen[:, None], rays, 0.0), axis=1) < _LARGEST_TANGENT
    for row, camera in enumerate(cameras):
        part = slice(start[row], start[row + 1])
        values = new[camera.id].parameters
        pixels = rays[part] * values[:2] + values[2:]
        uv[rows[row]] = np.where(seen[part, None], pixels, -1.0)
    point[chosen[~seen]] = NO_POINT
    return dataclasses.replace(
        model,
        cameras=tuple(new.get(camera.id, camera) for camera in model.cameras),
        images=dataclasses.replace(images, uv=uv, point=point),
    )


def _pinhole(camera: ColmapCamera) -> ColmapCamera:
    has_single_focal_length = len(camera.parameters) == 4  # SIMPLE_DIVISION: f cx cy k
    values = camera.parameters[[0, 0, 1, 2]] if has_single_focal_length else camera.parameters[:4]
    return dataclasses.replace(camera, model=_PINHOLE, parameters=values)
