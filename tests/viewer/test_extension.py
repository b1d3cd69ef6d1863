"""Layers that plugins add: drawn where the map is drawn, and never fatal."""

from collections.abc import Iterator

import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.plugin import LayerLines, LayerPoints, viewer_layer
from maplab_py.viewer import extension
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import WHOLE_MAP, Points, Scene, Segments
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex_list
from maplab_py.vimap.merge import merge_maps
from tests.vimap.builders import walk_map

P_G = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, np.nan]])
ENDS_G = np.arange(12.0).reshape(2, 2, 3)


@pytest.fixture(autouse=True)
def only_own_layers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(extension, "REGISTERED", {})
    return


def _scene(**options: float) -> Scene:
    vi_map = merge_maps(walk_map(seed=1), walk_map(seed=2, first_ns=10**10))[0]
    return build_scene(Subject(vi_map, "test", VisualizationOptions(**options)))


def test_points_of_the_whole_map() -> None:
    viewer_layer("marks", title="Marks")(lambda _: LayerPoints(P_G, colours=(1, 2, 3), size_m=0.5))
    layer = _scene().layer("marks")
    part = layer.parts[WHOLE_MAP]
    assert isinstance(part, Points)
    np.testing.assert_array_equal(part.p, P_G[:2])  # what is not finite is left out
    assert (part.colours == [1, 2, 3]).all()
    assert part.rows.tolist() == [0, 1]
    assert (part.size_m, layer.title, layer.total, layer.is_visible) == (0.5, "Marks", 3, True)


def test_lines_move_with_their_missions() -> None:
    def edges(vi_map: VIMap) -> LayerLines:
        return LayerLines(ENDS_G, np.array([[9, 9, 9], [8, 8, 8]]), np.array([1, 0]), 4.0)

    viewer_layer("edges", is_visible=False)(edges)
    scene = _scene(spatially_distribute_missions_meters=10.0)
    first, second = (scene.layer("edges").parts[mission.id] for mission in scene.missions)
    assert isinstance(first, Segments)
    assert isinstance(second, Segments)
    np.testing.assert_array_equal(first.ends, ENDS_G[1:])
    np.testing.assert_array_equal(second.ends, ENDS_G[:1] + np.array([10.0, 0.0, 0.0]))
    assert first.colours.tolist() == [[8, 8, 8]]
    assert (second.width_px, scene.layer("edges").is_visible) == (4.0, False)


def test_a_layer_sees_the_map_that_is_drawn() -> None:
    def every_vertex(vi_map: VIMap) -> LayerPoints:
        return LayerPoints(vi_map.T_G_I[:, 4:], missions=vi_map.vertices.mission)

    viewer_layer("all_vertices")(every_vertex)
    scene = _scene()
    own, usual = scene.layer("all_vertices"), scene.layer("vertices")
    assert sorted(own.parts) == sorted(usual.parts)
    for mission_id, part in usual.parts.items():
        np.testing.assert_array_equal(own.parts[mission_id].p, part.p)


def test_what_a_map_has_not_is_left_out() -> None:
    viewer_layer("nothing")(lambda _: LayerPoints(np.zeros((0, 3))))
    scene = _scene()
    assert "nothing" not in scene.names
    assert scene.notes == ()


def _raises(error: Exception) -> LayerPoints:
    raise error


@pytest.mark.parametrize(
    ("function", "problem"),
    [
        (lambda _: _raises(ZeroDivisionError("by nothing")), "ZeroDivisionError: by nothing"),
        (lambda _: _raises(UserError("no laser here")), "no laser here"),
        (lambda _: None, "gave NoneType, not LayerPoints or LayerLines"),
        (lambda _: LayerPoints(P_G[:, :2]), "positions are (3, 2), not (N, 3)"),
        (lambda _: LayerLines(P_G), "positions are (3, 3), not (N, 2, 3)"),
        (lambda _: LayerPoints(P_G, np.zeros((2, 3))), "colours are (2, 3), not (3,) or (3, 3)"),
        (lambda _: LayerPoints(P_G, missions=np.array([0, 1, 2])), "3 numbers below 2"),
        (lambda _: LayerPoints(P_G, missions=np.array([0, 1])), "3 numbers below 2"),
    ],
)
def test_a_broken_layer_is_named_and_the_rest_is_drawn(function, problem: str) -> None:
    viewer_layer("broken")(function)
    viewer_layer("sound")(lambda _: LayerPoints(P_G))
    scene = _scene()
    (note,) = scene.notes
    assert note.startswith("layer broken: ")
    assert problem in note
    assert "sound" in scene.names
    assert "broken" not in scene.names


def test_names_of_the_viewer_are_taken() -> None:
    viewer_layer("vertices")(lambda _: LayerPoints(P_G))
    scene = _scene()
    assert scene.notes == ("layer vertices: the viewer has one of this name",)
    assert scene.layer("vertices").total == 24


def test_a_name_is_an_identifier() -> None:
    with pytest.raises(ValueError, match="letters, digits and underscores"):
        viewer_layer("a/b")


def test_missions_keep_their_ids() -> None:
    viewer_layer("two")(lambda _: LayerPoints(P_G, missions=np.array([1, 1, 0])))
    vi_map = merge_maps(walk_map(seed=1), walk_map(seed=2, first_ns=10**10))[0]
    layer = build_scene(Subject(vi_map)).layer("two")
    assert sorted(layer.parts) == sorted(to_hex_list(vi_map.missions.id))
