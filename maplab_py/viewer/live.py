"""A scene with new positions of the same things, as cheaply as can be."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F64
from maplab_py.viewer.drawing import Drawing
from maplab_py.viewer.end_labels import PATH_ENDS
from maplab_py.viewer.scene import Layer, Part, Points, Scene, Segments
from maplab_py.vimap import VIMap

_VERTEX_LAYERS = ("vertices", PATH_ENDS)
_PATH_LAYERS = ("trajectories",)
_LANDMARK_LAYERS = ("landmarks", "bad_landmarks")


def moved_scene(scene: Scene, drawing: Drawing, vi_map: VIMap) -> Scene:
    """Return the scene with trajectories, vertices and landmarks where a map has them now.

    Args:
        scene: The scene as it is shown.
        drawing: What it was drawn of.
        vi_map: A map with the same rows whose positions differ.
    """
    if len(vi_map.vertices) != len(drawing.vi_map.vertices) or len(vi_map.landmarks) != len(
        drawing.vi_map.landmarks
    ):
        return scene
    moved = dataclasses.replace(drawing, vi_map=vi_map)
    return dataclasses.replace(scene, layers=tuple(_moved(layer, moved) for layer in scene.layers))


def _moved(layer: Layer, drawing: Drawing) -> Layer:
    if layer.name in _VERTEX_LAYERS:
        parts = {key: _at(part, drawing.p_vertices) for key, part in layer.parts.items()}
    elif layer.name in _LANDMARK_LAYERS:
        parts = {key: _at(part, drawing.p_landmarks) for key, part in layer.parts.items()}
    elif layer.name in _PATH_LAYERS:
        parts = {key: _along(part, drawing.p_vertices) for key, part in layer.parts.items()}
    else:
        return layer
    return dataclasses.replace(layer, parts=parts)


def _at(part: Part, p: F64) -> Part:
    if not isinstance(part, Points):
        return part
    return dataclasses.replace(part, p=p[part.rows].astype(np.float32))


def _along(part: Part, p: F64) -> Part:
    if not isinstance(part, Segments):
        return part
    ends = np.stack([p[part.rows], p[part.rows + 1]], axis=1)
    return dataclasses.replace(part, ends=ends.astype(np.float32))
