"""The panel's texts, plots of the time line, files of Rerun."""

import base64
import dataclasses
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from maplab_py.console.session.session import Session
from maplab_py.errors import UserError
from maplab_py.sensors.projection import back_project
from maplab_py.viewer.building import Subject, build_scene
from maplab_py.viewer.display import panel
from maplab_py.viewer.display.playback_control import image_tag, plot_paths, strip_chart, value_text
from maplab_py.viewer.display.rerun_scene import show_in_rerun
from maplab_py.viewer.layers.cameras import mission_cameras
from maplab_py.viewer.options import VisualizationOptions
from maplab_py.viewer.playback import Signal
from maplab_py.viewer.resource_clouds import VertexImages
from maplab_py.viewer.scene import LegendEntry, Scene
from maplab_py.vimap.queries import mission_labels
from tests.interop.bags.small_bags import map_with_resources
from tests.vimap.builders import walk_map

HOSTILE = "<img src=x onerror=alert(1)> & co"
SHOWN = "&lt;img src=x onerror=alert(1)&gt; &amp; co"


def scene(title: str) -> Scene:
    return build_scene(Subject(walk_map(), title, VisualizationOptions()))


@pytest.mark.parametrize(
    "markup",
    [
        lambda: panel.header(scene(HOSTILE)),
        lambda: panel.header(dataclasses.replace(scene("map"), notes=(HOSTILE,))),
        lambda: panel.legend([LegendEntry(HOSTILE, ("#000000",))]),
        lambda: panel.legend([LegendEntry(HOSTILE, ("#000000", "#ffffff"), "0", "1")]),
        lambda: panel.legend([LegendEntry("seen", ("#000000", "#ffffff"), HOSTILE, "1")]),
        lambda: panel.legend([LegendEntry("seen", ("#000000", "#ffffff"), "0", HOSTILE)]),
        lambda: panel.fact_table([(HOSTILE, "value")]),
        lambda: panel.fact_table([("name", HOSTILE)]),
        lambda: panel.hint(HOSTILE),
    ],
)
def test_texts_are_escaped(markup) -> None:
    html = markup()
    assert SHOWN in html
    assert "<img" not in html


ALL = np.arange(50)


def _corners(path: str) -> np.ndarray:
    return np.array([[float(x), float(y)] for x, y in re.findall(r"[ML](\S+) (-?\d+)", path)])


def _signal(values: np.ndarray) -> Signal:
    return Signal("speed", "m/s", values.reshape(len(values), -1), 2)


def test_a_curve_rises_where_the_value_does() -> None:
    (path,) = plot_paths(_signal(np.linspace(-3.0, 3.0, 50)), ALL, np.linspace(0.0, 1.0, 50))
    corners = _corners(path)
    assert path.count("M") == 1
    assert len(corners) == 50
    assert (np.diff(corners[:, 0]) > 0).all()
    assert (np.diff(corners[:, 1]) <= 0).all()  # SVG counts y downwards
    assert corners[0, 0] == 0.0
    assert corners[-1, 0] == 1000.0


def test_unknown_values_are_gaps() -> None:
    values = np.sin(np.arange(50.0))
    values[[10, 11, 30]] = np.nan
    (path,) = plot_paths(_signal(values), ALL, ALL / 49.0)
    assert path.count("M") == 3
    assert len(_corners(path)) == 47
    assert plot_paths(_signal(np.full(50, np.nan)), ALL, ALL / 49.0) == ("",)


def test_long_curves_are_thinned_and_keep_their_peaks() -> None:
    values = np.zeros(20_000)
    values[7_777] = 1.0
    values[::2] += 0.001
    rows = np.arange(20_000)
    (path,) = plot_paths(_signal(values), rows, rows / 20_000.0)
    corners = _corners(path)
    assert len(corners) <= 500
    peak = corners[np.argmin(corners[:, 1])]
    assert abs(peak[0] - 388.85) < 5.0


def test_a_constant_has_a_flat_line_and_vectors_have_three() -> None:
    (path,) = plot_paths(_signal(np.full(50, 7.0)), ALL, ALL / 49.0)
    assert len(set(_corners(path)[:, 1])) == 1
    assert len(plot_paths(_signal(np.ones((50, 3))), ALL, ALL / 49.0)) == 3


def test_values_have_their_unit() -> None:
    signal = _signal(np.array([[1.0, -2.0, 0.5], [np.nan, 0.0, 0.0]]))
    assert value_text(signal, 0) == "1.00 -2.00 0.50 m/s"
    assert value_text(signal, 1) == "-"


def test_the_chart_marks_the_position_and_escapes_titles() -> None:
    chart = strip_chart([("<b>", ("M0 0L9 9",), "3 px")], 0.25, "<img src='data:'>")
    assert "M250.0 0V100" in chart
    assert "&lt;b&gt;" in chart
    assert "<b>" not in chart
    assert chart.count("<img") == 1


def test_images_keep_their_colours_and_shape() -> None:
    image = np.zeros((240, 640, 3), dtype=np.uint8)
    image[:, :, 0] = 200  # red
    code = re.search(r"base64,([^']+)", image_tag(image))
    assert code is not None
    data = np.frombuffer(base64.b64decode(code[1]), dtype=np.uint8)
    shown = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert shown.shape == (120, 320, 3)
    assert abs(int(shown[60, 160, 2]) - 200) < 6
    assert int(shown[60, 160, 0]) < 10


needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None,
    reason="no rerun-sdk: pip install 'maplab-py[rerun]'",
)


def read(file: Path) -> dict[str, list[Any]]:
    """Return the record batches of each entity."""
    from rerun.chunk import RrdReader

    batches: dict[str, list[Any]] = {}
    for chunk in RrdReader(str(file)).store().stream():
        path = chunk.entity_path.replace("\\ ", " ")
        batches.setdefault(path, []).append(chunk.to_record_batch())
    return batches


def values(batches: list[Any], component: str) -> list[Any]:
    """Return the rows of a component, in the order of the rows."""
    columns = [b.column(component).to_pylist() for b in batches if component in b.schema.names]
    return [value for column in columns for value in column if value is not None]


@needs_rerun
def test_layers_are_those_of_the_scene(tmp_path: Path) -> None:
    subject = Subject(walk_map(), "walk")
    scene = show_in_rerun(subject, None, tmp_path / "walk.rrd")
    batches = read(tmp_path / "walk.rrd")
    names = {mission.id: mission.name for mission in scene.missions}
    assert scene.names == build_scene(subject).names
    for layer in scene.layers:
        drawn = [
            f"/map/{layer.title}/{names[m]}" if m else f"/map/{layer.title}" for m in layer.parts
        ]
        assert set(drawn) <= set(batches)
    (landmarks,) = scene.layer("landmarks").parts.values()
    (positions,) = values(batches[f"/map/Landmarks/{scene.missions[0].name}"], "Points3D:positions")
    assert np.array_equal(np.float32(positions), landmarks.p)  # type: ignore[union-attr]
    closures = values(batches["/map/Loop closures"], "LineStrips3D:strips")
    assert sum(map(len, closures)) == 2


@needs_rerun
def test_poses_and_images_have_the_times_of_the_vertices(tmp_path: Path) -> None:
    vi_map, images, _ = map_with_resources()
    pictures = VertexImages(vi_map, tmp_path)
    show_in_rerun(Subject(vi_map, "room"), pictures, tmp_path / "room.rrd")
    batches = read(tmp_path / "room.rrd")
    body = f"/map/Body/{mission_labels(vi_map)[0]}"
    rows = slice(*vi_map.vertex_start[:2].tolist())
    (poses,) = batches[body]
    times_ns = poses.column("time").cast("int64").to_numpy()
    assert np.array_equal(times_ns, vi_map.vertices.timestamp_ns[rows])
    p = np.squeeze(values(batches[body], "Transform3D:translation"))
    q = np.squeeze(values(batches[body], "Transform3D:quaternion"))
    assert np.allclose(np.hstack([q, p]), vi_map.T_G_I[rows], atol=1e-6)
    blobs = [blob for (blob,) in values(batches[f"{body}/cam0"], "EncodedImage:blob")]
    assert len(blobs) == len(images)
    for blob, image in zip(blobs, images, strict=True):
        decoded = cv2.imdecode(np.frombuffer(bytes(blob), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert decoded.shape == image.shape
        assert np.abs(decoded.astype(float) - image).mean() < 12.0  # noise, as JPEG


@needs_rerun
def test_the_corners_of_the_pinhole_are_those_of_the_camera(tmp_path: Path) -> None:
    vi_map = walk_map()
    show_in_rerun(Subject(vi_map, "walk"), None, tmp_path / "walk.rrd")
    batches = read(tmp_path / "walk.rrd")
    place = f"/map/Body/{mission_labels(vi_map)[0]}/cam0"
    (K,) = np.array(values(batches[place], "Pinhole:image_from_camera"))
    K = K.reshape(3, 3).T  # columns
    camera = mission_cameras(vi_map, 0)[0].camera
    corners = np.array([[0.0, 0.0], [camera.width_px, camera.height_px]])
    rays, _ = back_project(camera, corners)
    assert np.allclose((rays / rays[:, 2:] @ K.T)[:, :2], corners, atol=1e-3)


@pytest.fixture
def session() -> Iterator[Session]:
    with Session() as session:
        session.maps.add("walk", walk_map())
        yield session


@needs_rerun
def test_visualize_writes_the_file_and_keeps_one_that_exists(
    session: Session, tmp_path: Path
) -> None:
    file = tmp_path / "walk.rrd"
    report = session.run("visualize", viewer="rerun", viewer_file=f"{file}")
    assert report.url == str(file)
    assert ("Vertices", 12, True) in [(la.layer, la.in_map, la.visible) for la in report.layers]
    with pytest.raises(UserError, match=r"walk\.rrd exists"):
        session.run("visualize", viewer="rerun", viewer_file=f"{file}")


def test_what_rerun_needs_is_said(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(UserError, match=r"no desktop here: give --viewer_file=map\.rrd"):
        session.run("visualize", viewer="rerun")
    with pytest.raises(UserError, match="--viewer_file is for --viewer=rerun"):
        session.run("visualize", viewer_file=f"{tmp_path}/walk.rrd")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"pip install 'maplab-py\[rerun\]'"):
        session.run("visualize", viewer="rerun", viewer_file=f"{tmp_path}/walk.rrd")
