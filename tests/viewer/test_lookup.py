"""An id leads to what it names."""

from __future__ import annotations

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.picking import find_by_id
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.ids import to_hex
from tests.vimap.builders import walk_map

MAP = walk_map()
DRAWING = make_drawing(MAP, VisualizationOptions())


@pytest.mark.parametrize("digits", [12, 16, 20, 32])
def test_ids_and_their_beginnings_are_understood(digits: int) -> None:
    vertex = find_by_id(DRAWING, to_hex(MAP.vertices.id[3])[:digits])
    assert (vertex.entity, vertex.row) == (Entity.VERTEX, 3)
    np.testing.assert_allclose(vertex.p, MAP.T_G_I[3, 4:])
    landmark = find_by_id(DRAWING, f"  {to_hex(MAP.landmarks.id[7])[:digits].upper()} ")
    assert (landmark.entity, landmark.row) == (Entity.LANDMARK, 7)
    np.testing.assert_allclose(landmark.p, MAP.p_G[7])
    closure = find_by_id(DRAWING, to_hex(MAP.loop_closure_edges.id[1])[:digits])
    assert (closure.entity, closure.row) == (Entity.LOOP_CLOSURE, 1)
    mission = find_by_id(DRAWING, to_hex(MAP.missions.id[0])[:digits])
    assert (mission.entity, mission.row) == (Entity.VERTEX, 0)


def test_ids_that_mean_nothing_are_refused() -> None:
    for text in ("abc", "hello", "0" * 33, ""):
        with pytest.raises(UserError, match="4 to 32 hexadecimal digits"):
            find_by_id(DRAWING, text)
    with pytest.raises(UserError, match="no vertex, landmark, loop closure or mission"):
        find_by_id(DRAWING, "0" * 32)


def test_a_beginning_of_several_ids_asks_for_more_digits() -> None:
    ids = np.array(MAP.vertices.id)
    ids[5] = ids[4] + np.array([0, 1], dtype=np.uint64)
    vi_map = MAP.replace(vertices=MAP.vertices.replace(id=ids))
    drawing = make_drawing(vi_map, VisualizationOptions())
    with pytest.raises(UserError, match=r"2 ids start with .* \(vertex\): give more digits"):
        find_by_id(drawing, to_hex(ids[4])[:20])


def test_a_landmark_without_position_is_not_shown() -> None:
    p_I = np.array(MAP.landmarks.p_I)
    p_I[2] = np.nan
    vi_map = MAP.replace(landmarks=MAP.landmarks.replace(p_I=p_I))
    drawing = make_drawing(vi_map, VisualizationOptions())
    with pytest.raises(UserError, match="this landmark has no finite position"):
        find_by_id(drawing, to_hex(vi_map.landmarks.id[2]))
