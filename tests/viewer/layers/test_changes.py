"""The layer of changes between sessions, and their images."""

import dataclasses

import numpy as np

from maplab_py.algorithms.map_update.options import Change
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.layers.changes import ChangeImages
from maplab_py.viewer.scene import WHOLE_MAP, Points, Segments
from maplab_py.vimap import to_hex
from tests.vimap.builders import walk_map

BEFORE, AFTER = walk_map(seed=1), walk_map(seed=2)


def change(kind: str, vertex: int, to_m: str = "") -> Change:
    views = [to_hex(m.vertices.id[vertex]) for m in (BEFORE, AFTER)]
    dates = ("2026-01-01", "2026-02-01")
    return Change(kind, 1.0, 2.0, 0.5, 0.8, 9, 12, *dates, to_m, views[0], views[1])


CHANGES = (change("vanished", 0), change("moved", 2, "2.00 2.00 0.50"))


def test_changes_are_boxes_with_dates() -> None:
    scene = build_scene(Subject(BEFORE, changes=CHANGES))
    layers = {layer.name: layer for layer in scene.layers}
    boxes = layers["changes"].parts[WHOLE_MAP]
    assert isinstance(boxes, Segments)
    assert len(boxes) == 12 + 13
    corners = boxes.ends[:12].reshape(-1, 3) + scene.origin_G
    np.testing.assert_allclose(np.ptp(corners, axis=0), 0.8, atol=1e-5)
    names = layers["change_names"].parts[WHOLE_MAP]
    assert isinstance(names, Points)
    assert names.labels == ("vanished by 2026-02-01", "moved by 2026-02-01")
    assert names.rows.tolist() == [0, 2]
    assert "changes" not in {layer.name for layer in build_scene(Subject(BEFORE)).layers}


def test_a_vertex_that_is_gone_has_a_box_and_no_name() -> None:
    gone = dataclasses.replace(CHANGES[0], view_before=to_hex(AFTER.vertices.id[0]))
    layers = {la.name for la in build_scene(Subject(BEFORE, changes=(gone,))).layers}
    assert "changes" in layers
    assert "change_names" not in layers


def test_images_of_a_change_are_side_by_side() -> None:
    def image_of(value: int, height: int) -> np.ndarray:
        return np.full((height, 10, 3), value, dtype=np.uint8)

    images = ChangeImages(
        (BEFORE, lambda row: image_of(row, 6) if row < 4 else None),
        (AFTER, lambda row: image_of(100 + row, 8)),
        CHANGES,
    )
    both = images(2)
    assert both is not None
    assert both.shape == (10, 32, 3)
    assert (both[7, 0, 0], both[9, 20, 0], both[9, 0, 0]) == (2, 102, 255)
    single = images(1)
    assert single is not None
    assert single.shape == (6, 10, 3)
    assert images(7) is None
