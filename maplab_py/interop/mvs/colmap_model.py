"""COLMAP's sparse model of a scene: cameras.bin, images.bin, points3D.bin, with ids from one."""

from __future__ import annotations

import numpy as np

from maplab_py.array_types import I64
from maplab_py.geometry import se3
from maplab_py.interop.colmap.binary import binary_files
from maplab_py.interop.colmap.model import (
    MODELS,
    PIXEL_CENTRE,
    ColmapCamera,
    ColmapFrames,
    ColmapImages,
    ColmapModel,
    ColmapPoints,
)
from maplab_py.interop.mvs.scene import MvsScene

_FILES = ("cameras.bin", "images.bin", "points3D.bin")
"""Files of a dense workspace; undistorted images are not synchronised, so there are no rigs."""
_PINHOLE = next(model.number for model in MODELS.values() if model.name == "PINHOLE")


def encode_model(scene: MvsScene) -> dict[str, bytes]:
    """Return the files of a model by their names; every image has its observations in their order."""
    files = binary_files(_model(scene))
    return {name: b"".join(files[name]) for name in _FILES}


def _model(scene: MvsScene) -> ColmapModel:
    centre = np.array([0.0, 0.0, PIXEL_CENTRE, PIXEL_CENTRE])
    cameras = tuple(
        ColmapCamera(row + 1, _PINHOLE, width, height, scene.K[row] + centre)
        for row, (width, height) in enumerate(scene.size_px.tolist())
    )
    order = np.argsort(scene.view, kind="stable")
    images = ColmapImages(
        id=_ids(len(scene.names)),
        camera=scene.camera + 1,
        T_C_W=scene.T_C_G,
        name=tuple(scene.names),
        keypoint_count=np.bincount(scene.view, minlength=len(scene.names)),
        uv=scene.uv_px[order] + PIXEL_CENTRE,
        point=scene.landmark[order] + 1,
    )
    points = ColmapPoints(_ids(len(scene.p_G)), scene.p_G, scene.colours, scene.error_px)
    none = np.zeros(0, dtype=np.int64)
    return ColmapModel(
        cameras, (), ColmapFrames(none, none, se3.identity(0), none, none), images, points
    )


def _ids(count: int) -> I64:
    return np.arange(1, count + 1, dtype=np.int64)
