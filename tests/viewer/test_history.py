"""The states of a map's history: their errors, and what is drawn of each."""

import io
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from maplab_plugins.visualization.following import states_of
from PIL import Image

from maplab_py.console.session.maps import MapEntry
from maplab_py.errors import UserError
from maplab_py.interop.trajectories import Trajectory
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display import animation
from maplab_py.viewer.display.animation import evenly_spread, gif, save_animation, with_caption
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.drawing import make_drawing
from maplab_py.viewer.history import MAX_STATES, State, error_curves, history_chart, state_layers
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.scene import Segments
from maplab_py.vimap import VIMap
from tests.viewer.display.page_messages import page_state
from tests.vimap.builders import walk_map

MAP = walk_map(vertices=14, landmarks=300, seed=3)


def _bent(vi_map: VIMap, metres: float) -> VIMap:
    T = np.array(vi_map.vertices.T_M_I)
    T[:, 6] += metres * np.linspace(0.0, 1.0, len(T)) ** 2
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T))


def test_errors_fall_with_the_distance_from_the_truth() -> None:
    states = [State("", _bent(MAP, 1.0)), State("relax", _bent(MAP, 0.2)), State("optvi", MAP)]
    truth = Trajectory(MAP.vertices.timestamp_ns, MAP.T_G_I, source="truth")
    curves = {curve.title: curve.values for curve in error_curves(states, truth)}
    assert set(curves) == {"reprojection, median", "error to the truth, RMSE"}
    for values in curves.values():
        assert values[0] > 2.0 * values[1] > 4.0 * values[2] >= 0.0
    assert curves["error to the truth, RMSE"][2] == pytest.approx(0.0, abs=1e-9)


def test_the_chart_names_the_command_and_its_errors() -> None:
    states = [State("", _bent(MAP, 1.0)), State("relax --a=<b>", MAP)]
    curves = error_curves(states)
    text = history_chart(states, curves, 1)
    assert "2 of 2: relax --a=&lt;b&gt;" in text
    assert f"{curves[0].values[1]:.3f} px" in text
    assert "before the first command" in history_chart(states, (), 0)


def test_a_state_is_drawn_where_the_map_has_its_origin() -> None:
    drawing = make_drawing(MAP, VisualizationOptions(max_points=100))
    paths, points = state_layers(drawing, State("", _bent(MAP, 5.0)), states=4)
    assert paths.drawn == len(MAP.vertices) - 1
    assert 0 < points.drawn <= 100
    subject = Subject(MAP, history=(State("", _bent(MAP, 5.0)), State("relax", MAP)))
    assert (subject.place, subject.replace(state=0).place) == (1, 0)
    past, now = (build_scene(subject.replace(state=place)) for place in (0, -1))
    assert past.extent.radius_m > now.extent.radius_m


def test_of_many_states_an_animation_has_some_that_are_spread_over_all() -> None:
    assert evenly_spread(3).tolist() == [0, 1, 2]
    chosen = evenly_spread(500)
    assert (len(chosen), chosen[0], chosen[-1]) == (MAX_STATES, 0, 499)
    assert np.ptp(np.diff(chosen)) <= 1


def test_an_animation_shows_its_frames_again_and_again() -> None:
    plain = np.full((60, 90, 3), 255, dtype=np.uint8)
    frames = [with_caption(plain, (f"{k} of 3: relax",), is_dark=False) for k in range(3)]
    assert all(0 < np.count_nonzero(frame != plain) < 0.2 * plain.size for frame in frames)
    with Image.open(io.BytesIO(gif(frames))) as picture:
        assert (picture.n_frames, picture.size, picture.info["loop"]) == (3, (90, 60), 0)
        assert picture.info["duration"] == 1200


def test_a_state_is_swiped_over_the_map() -> None:
    history = (State("", _bent(MAP, 5.0)), State("relax", MAP))
    swiped = Subject(MAP, history=history).at_state(0, swipes=True)
    assert (swiped.place, swiped.shown) == (0, MAP)
    scene = build_scene(swiped)
    path, other = (scene.layer(f"{side}trajectories").parts for side in ("", "swiped_"))
    p = np.concatenate([part.ends for part in other.values() if isinstance(part, Segments)])
    np.testing.assert_allclose(p[:, 0], history[0].vi_map.T_G_I[:-1, 4:], atol=1e-4)
    assert len(path) == len(other) == 1
    assert scene.notes[0] == "left of the line: before the first command"
    back = swiped.at_state(1, swipes=False)
    assert (back.place, back.other, back.arrangement) == (1, None, "over")


def test_a_map_left_of_the_line_that_is_no_state_leaves_the_slider_at_the_map() -> None:
    history = (State("", _bent(MAP, 5.0)), State("relax", MAP))
    subject = Subject(MAP, history=history, other=_bent(MAP, 1.0), arrangement="swipe")
    viewer = Viewer(0)
    try:
        viewer.show(subject)
        assert page_state(viewer).control(label="state")["value"] == 1
    finally:
        viewer.stop()
    back = subject.at_state(1, swipes=False)
    assert (back.other, back.place) == (None, 1)


def test_an_animation_has_each_state_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    history = (State("", _bent(MAP, 5.0)), State("relax", MAP))
    subject = Subject(MAP, history=history).at_state(0, swipes=True)
    viewer = Viewer(0)
    shown: list[tuple[int, object]] = []

    def render(*_: object, **__: object) -> np.ndarray:
        assert viewer.subject is not None
        shown.append((viewer.subject.place, viewer.subject.other))
        return np.zeros((20, 30, 3), dtype=np.uint8)

    monkeypatch.setattr(animation, "open_client", lambda *_: nullcontext())
    monkeypatch.setattr(animation, "point_camera", lambda *_: {})
    monkeypatch.setattr(animation, "render", render)
    try:
        viewer.show(subject)
        with pytest.raises(UserError, match="is a folder"):
            save_animation(viewer, tmp_path, (30, 20))
        assert save_animation(viewer, tmp_path / "history.gif", (30, 20)) == (2, 2)
        assert viewer.subject == subject
    finally:
        viewer.stop()
    assert shown == [(0, None), (1, None)]


def test_the_history_is_what_undo_and_redo_lead_to() -> None:
    entry = MapEntry("map", VIMap()).with_value(_bent(MAP, 1.0), "load").with_value(MAP, "relax")
    assert [state.command for state in states_of(entry)] == ["load", "relax"]
    undone = entry.undone()
    assert [state.command for state in states_of(undone)] == ["load", "relax"]
    assert Subject(undone.vi_map, history=states_of(undone)).place == 0
