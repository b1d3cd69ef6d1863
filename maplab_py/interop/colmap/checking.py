"""Checks of references within a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from maplab_py.array_types import I64, Mask
from maplab_py.errors import MapError
from maplab_py.interop.colmap.binary_reading import REMEDY
from maplab_py.interop.colmap.model import NO_POINT, ColmapModel, SensorType


def check_model(model: ColmapModel, source: Path) -> None:
    """Check that ids are unique, that what is named exists, and that there are images.

    Raises:
        MapError: A check fails; names the source and the id.
    """
    images, frames, points = model.images, model.frames, model.points
    if not len(images.id):
        raise MapError(f"{source}: the model has no images with a pose: nothing can be imported")
    cameras = np.array([camera.id for camera in model.cameras], dtype=np.int64)
    rigs = np.array([rig.id for rig in model.rigs], dtype=np.int64)
    sensors = np.array(
        [number for rig in model.rigs for kind, number in rig.sensors if kind == SensorType.CAMERA],
        dtype=np.int64,
    )
    for noun, ids in (
        ("camera", cameras),
        ("rig", rigs),
        ("camera in a rig", sensors),
        ("frame", frames.id),
        ("image", images.id),
        ("image in a frame", frames.image_id),
        ("point", points.id),
    ):
        values, counts = np.unique(ids, return_counts=True)
        _refuse(source, f"{noun} {{}} is there twice", values, counts > 1)
    names, counts = np.unique(np.array(images.name), return_counts=True)
    if np.any(counts > 1):
        raise MapError(
            f"{source}: two images are called '{names[counts > 1][0]}': give each its own name"
        )
    _known(source, "an image names camera {}", images.camera, cameras)
    _known(source, "a frame names rig {}", frames.rig, rigs)
    _known(source, "no frame has image {}", images.id, frames.image_id)
    _known(source, "no rig has camera {}", images.camera, sensors)
    observed = images.point[images.point != NO_POINT]
    _known(source, "a keypoint names point {}", observed, points.id)


def _known(source: Path, sentence: str, named: I64, known: I64) -> None:
    _refuse(source, f"{sentence}, which is not there", named, ~np.isin(named, known))


def _refuse(source: Path, sentence: str, ids: I64, wrong: Mask) -> None:
    if np.any(wrong):
        text = sentence.format(int(ids[wrong][0]))
        if text.startswith("no "):
            text = text.removesuffix(", which is not there")
        raise MapError(f"{source}: is damaged: {text}; {REMEDY}")
