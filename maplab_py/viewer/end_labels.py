"""Labels of ends of paths: those that lie close together are lines of one label."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.array_types import F32
from maplab_py.viewer.scene import Points, Scene

PATH_ENDS = "path_ends"
"""Name of the layer with a part of two points, start and end, for each mission."""
_NEAR = 0.2
"""Ends that are closer than this part of the scene's radius share a label."""


@dataclasses.dataclass
class _Label:
    mission: str
    row: int
    p: F32  # (3,)
    lines: list[str]


def with_end_labels(scene: Scene, missions: set[str]) -> Scene:
    """Return a scene in which ends of paths that lie close together share one label.

    Args:
        scene: A scene whose ends have a label each.
        missions: Ids of the visible missions; the ends of the others have no label.
    """
    if PATH_ENDS not in scene.names:
        return scene
    layer = scene.layer(PATH_ENDS)
    points = {key: part for key, part in layer.parts.items() if isinstance(part, Points)}
    near_m = _NEAR * scene.extent.radius_m
    labels: list[_Label] = []
    for mission, part in points.items():
        if mission not in missions:
            continue
        for row, line in enumerate(part.labels):
            near = (label for label in labels if np.linalg.norm(label.p - part.p[row]) < near_m)
            label = next(near, None)
            if label is None:
                labels.append(_Label(mission, row, part.p[row], [line]))
            else:
                label.lines.append(line)
    texts = {(label.mission, label.row): "\n".join(label.lines) for label in labels}
    parts = dict(layer.parts)
    for mission, part in points.items():
        if part.labels:
            lines = tuple(texts.get((mission, row), "") for row in range(len(part.labels)))
            parts[mission] = dataclasses.replace(part, labels=lines if any(lines) else ())
    relabelled = dataclasses.replace(layer, parts=parts)
    layers = tuple(relabelled if other is layer else other for other in scene.layers)
    return dataclasses.replace(scene, layers=layers)
