"""Labels of ends of paths that lie close together."""

from __future__ import annotations

import dataclasses

import numpy as np

from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.drawing import PATH_ENDS, with_end_labels
from maplab_py.viewer.scene import Points, Scene
from tests.vimap.builders import walk_map


def _scene(ends: dict[str, list[list[float]]]) -> Scene:
    """Return a scene of 10 m radius with paths that start and end at given places."""
    scene = build_scene(Subject(walk_map()))
    layer = scene.layer(PATH_ENDS)
    (dots,) = layer.parts.values()
    assert isinstance(dots, Points)
    parts = {
        name: dataclasses.replace(
            dots, p=np.array(p, dtype=np.float32), labels=(f"start {name}", f"end {name}")
        )
        for name, p in ends.items()
    }
    layers = (dataclasses.replace(layer, parts=parts),)
    extent = dataclasses.replace(scene.extent, radius_m=10.0)
    return dataclasses.replace(scene, layers=layers, extent=extent)


def _labels(scene: Scene) -> dict[str, tuple[str, ...]]:
    parts = scene.layer(PATH_ENDS).parts
    return {name: part.labels for name, part in parts.items() if isinstance(part, Points)}


SCENE = _scene(
    {"a": [[0, 0, 0], [9, 0, 0]], "b": [[0.5, 0, 0], [0, 9, 0]], "c": [[9, 1, 0], [0, 0, 1]]}
)


def test_ends_close_together_are_lines_of_one_label() -> None:
    assert _labels(with_end_labels(SCENE, {"a", "b", "c"})) == {
        "a": ("start a\nstart b\nend c", "end a\nstart c"),
        "b": ("", "end b"),
        "c": (),
    }


def test_hidden_missions_have_no_label() -> None:
    labels = _labels(with_end_labels(SCENE, {"b", "c"}))
    assert labels["b"] == ("start b\nend c", "end b")
    assert labels["c"] == ("start c", "")


def test_ends_without_labels_stay_without() -> None:
    many = build_scene(Subject(walk_map()))
    dots = {
        key: dataclasses.replace(part, labels=())
        for key, part in many.layer(PATH_ENDS).parts.items()
    }  # type: ignore[call-arg]
    bare = dataclasses.replace(
        many, layers=(dataclasses.replace(many.layer(PATH_ENDS), parts=dots),)
    )
    assert set(_labels(with_end_labels(bare, set(dots))).values()) == {()}
