"""The viewer without a browser: what it serves, refuses, follows, and leaves alone."""

import contextlib
import gzip
import socket
import threading
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec.msgpack
import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from maplab_py.errors import UserError
from maplab_py.geometry import so3
from maplab_py.sensors import SensorSet
from maplab_py.viewer.building import Subject, make_checked_drawing
from maplab_py.viewer.display.camera import BEHIND, INSIDE, ride
from maplab_py.viewer.display.parts import add_part, by_user
from maplab_py.viewer.display.selection import fly
from maplab_py.viewer.display.server import page_script
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions
from maplab_py.viewer.playback import step_seconds
from maplab_py.viewer.scene import Points
from maplab_py.vimap import VIMap
from maplab_py.vimap.ids import to_hex
from maplab_py.vimap.merge import merge_maps
from tests.support.waiting import wait_until
from tests.viewer.display.page_messages import (
    Message,
    is_replayed,
    open_page,
    page_state,
    read_until,
)
from tests.vimap.builders import walk_map


@pytest.fixture(scope="module")
def two_missions() -> VIMap:
    return merge_maps(walk_map(seed=1), walk_map(vertices=9, seed=2, first_ns=10**10))[0]


@pytest.fixture
def viewer(two_missions: VIMap) -> Iterator[Viewer]:
    viewer = Viewer(0)
    viewer.show(Subject(two_missions, "test"))
    yield viewer
    viewer.stop()


def is_reachable(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def is_ground_hidden(message: Message) -> bool:
    """Tell whether the grid goes; a larger map sends another grid before its layers."""
    return message.get("name") == "/ground" and message.get("visible") is False


def _moved(vi_map: VIMap, metres: float) -> VIMap:
    T = np.array(vi_map.vertices.T_M_I)
    T[:, 4] += metres
    return vi_map.replace(vertices=vi_map.vertices.replace(T_M_I=T))


def test_it_listens_on_this_machine_only(viewer: Viewer) -> None:
    assert viewer.url == f"http://127.0.0.1:{viewer.port}"
    assert viewer.server.get_host() == "127.0.0.1"
    addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None)}
    for address in addresses - {"127.0.0.1", "::1"}:
        with pytest.raises(OSError, match=r".*"):
            socket.create_connection((address, viewer.port), timeout=0.5).close()


@pytest.mark.parametrize("origin", [None, "http://localhost:9999", "http://127.0.0.1:1"])
def test_own_pages_may_connect(viewer: Viewer, origin: str | None) -> None:
    protocol = f"viser-v{viser.__version__}"
    url = viewer.url.replace("http", "ws", 1)
    with connect(url, origin=origin, subprotocols=[protocol]) as connection:
        assert connection.recv(timeout=5.0)


@pytest.mark.parametrize("origin", ["https://evil.example", "http://localhost.evil.example"])
def test_pages_of_others_may_not(viewer: Viewer, origin: str) -> None:
    protocol = f"viser-v{viser.__version__}"
    with pytest.raises(InvalidStatus) as refusal:
        connect(
            viewer.url.replace("http", "ws", 1),
            origin=origin,
            subprotocols=[protocol],
        ).close()
    assert refusal.value.response.status_code == 403


def test_nothing_is_shared(viewer: Viewer) -> None:
    assert viewer.server.request_share_url() is None
    with open_page(viewer) as page:
        messages = read_until(page, is_replayed)
    themes = [m for m in messages if m["type"] == "ThemeConfigurationMessage"]
    assert [theme["show_share_button"] for theme in themes] == [False]


def test_a_busy_port_gives_the_next(viewer: Viewer, two_missions: VIMap) -> None:
    other = Viewer(viewer.port)
    try:
        assert other.port != viewer.port
        assert viewer.port < other.port < viewer.port + 100
    finally:
        other.stop()
    with pytest.raises(UserError, match="--viewer_port=70000"):
        Viewer(70_000)


def test_it_prints_nothing(two_missions: VIMap, capfd: pytest.CaptureFixture[str]) -> None:
    viewer = Viewer(0)
    viewer.show(Subject(two_missions, "test"))
    with socket.create_connection(("127.0.0.1", viewer.port)) as connection:
        connection.sendall(b"no http at all\r\n\r\n")
        connection.settimeout(20.0)
        while connection.recv(4096):  # the server refuses and closes the connection
            pass
    viewer.stop()
    viewer.stop()
    assert wait_until(lambda: not is_reachable(viewer.port))
    assert viewer.is_stopped
    assert capfd.readouterr() == ("", "")
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", viewer.port), timeout=1.0).close()


def test_following_sends_only_what_changed(viewer: Viewer, two_missions: VIMap) -> None:
    first_ids = two_missions.missions.id
    T = np.array(two_missions.vertices.T_M_I)
    T[12:, 4] += 0.5  # the second mission only
    subject = Subject(two_missions, "test")
    changed = two_missions.replace(vertices=two_missions.vertices.replace(T_M_I=T))
    before = page_state(viewer).drawn
    with open_page(viewer) as page:
        read_until(page, is_replayed)
        viewer.follow(subject.replace(vi_map=changed))
        assert viewer.wait(10.0)
        viewer.set_ground(False)
        messages = read_until(page, is_ground_hidden)
    assert page_state(viewer).drawn == before
    first = f"{first_ids[0, 0]:016x}{first_ids[0, 1]:016x}"
    names = [str(message.get("name", "")) for message in messages]
    sent = {tuple(name.split("/")[2:4]) for name in names if name.startswith("/map/")}
    for layer in ("trajectories", "vertices", "path_ends"):
        assert (layer, first) not in sent
    layers = {layer for layer, *_ in sent}
    assert layers == {"trajectories", "vertices", "path_ends", "landmarks", "loop_closures"}


def test_only_the_latest_wish_counts(viewer: Viewer, two_missions: VIMap) -> None:
    for step in range(20):
        viewer.follow(Subject(_moved(two_missions, 0.1 * step), "test"))
    last = _moved(two_missions, 9.0)
    viewer.follow(Subject(last, "test"))
    assert viewer.wait(20.0)
    assert viewer.subject is not None
    assert viewer.subject.vi_map is last


def test_a_map_that_cannot_be_shown_is_survived(viewer: Viewer, two_missions: VIMap) -> None:
    viewer.follow(Subject(VIMap(), "empty"))
    assert viewer.wait(10.0)
    assert viewer.subject is not None
    assert viewer.subject.vi_map is two_missions
    viewer.follow(Subject(_moved(two_missions, 1.0), "test"))
    assert viewer.wait(10.0)
    assert viewer.subject.vi_map is not two_missions


def test_layers_and_missions_can_be_hidden(viewer: Viewer, two_missions: VIMap) -> None:
    assert viewer.scene is not None
    first, second = (mission.id for mission in viewer.scene.missions)
    viewer.set_layer("landmarks", False)
    viewer.set_layer("imu_edges", True)
    layers = page_state(viewer).layers
    assert "landmarks" not in layers
    assert "imu_edges" in layers
    viewer.set_missions({second})
    assert first not in {mission for _, mission in page_state(viewer).drawn}
    viewer.follow(Subject(_moved(two_missions, 1.0), "test"))  # choices outlive an update
    assert viewer.wait(10.0)
    page = page_state(viewer)
    assert "landmarks" not in page.layers
    assert first not in {mission for _, mission in page.drawn}
    assert second in {mission for _, mission in page.drawn}


def test_an_id_selects_what_it_names(viewer: Viewer, two_missions: VIMap) -> None:
    camera = SimpleNamespace(position=np.array([0.0, -8.0, 6.0]), look_at=np.zeros(3))
    page = SimpleNamespace(camera=camera, atomic=threading.Lock)
    picked = viewer.selections.jump(viewer.drawing, to_hex(two_missions.landmarks.id[4]))
    fly(page, viewer.drawing, picked)
    assert viewer.selection.picked is picked
    assert picked.row == 4
    np.testing.assert_allclose(camera.look_at, two_missions.p_G[4])
    back = camera.position - camera.look_at
    np.testing.assert_allclose(back / np.linalg.norm(back), [0.0, -0.8, 0.6], atol=1e-9)
    with pytest.raises(UserError, match="no vertex, landmark"):
        viewer.fly_to("f" * 32)
    assert viewer.selection.picked is picked


def test_an_export_has_all_layers_and_leaves_the_page_as_it_was(
    viewer: Viewer, two_missions: VIMap, tmp_path: Path
) -> None:
    before = page_state(viewer).drawn
    viewer.export(tmp_path / "view.html")
    assert page_state(viewer).drawn == before
    text = (tmp_path / "view.html").read_text()
    assert viewer.scene is not None
    for layer in viewer.scene.layers:
        box = f"data-layer='{layer.name}'" + (" checked" if layer.is_visible else "")
        assert f"{box}>" in text
    assert ".maplab-swipe {" in text  # its script draws the swipe line


def test_colouring_changes_the_legend(viewer: Viewer) -> None:
    viewer.set_colouring("height")
    assert viewer.wait(10.0)
    page = page_state(viewer)
    assert "height" in page.html
    assert page.control(label="landmarks by")["value"] == "height"
    viewer.set_colouring("quality")
    assert viewer.wait(10.0)
    assert "not judged" in page_state(viewer).html


def test_the_space_bar_plays_and_pauses(viewer: Viewer) -> None:
    viewer.playback.configure(PlaybackOptions(steps=40, vertex_frequency=0.5))
    time_line = viewer.playback.time_line
    with open_page(viewer) as page:
        sent = read_until(page, is_replayed)
        commands = [m for m in sent if m["type"] == "RegisterCommandMessage"]
        (space,) = (m["uuid"] for m in commands if m["props"]["hotkey"] == "space")
        camera = {
            "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, 0.0, 9.0),
            "fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 480, "image_width": 640,
            "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
        }  # fmt: skip
        page.send(msgspec.msgpack.encode(camera))  # without which a page does not count yet
        assert wait_until(lambda: viewer.pages == 1)
        for is_playing in (True, False):
            press = {"type": "CommandTriggerMessage", "uuid": space}
            page.send(msgspec.msgpack.encode(press))
            assert wait_until(lambda wanted=is_playing: time_line.is_playing is wanted)
    assert viewer.player is not None


def test_playing_shows_the_map_grow(two_missions: VIMap) -> None:
    viewer = Viewer(0)
    try:
        playback = PlaybackOptions(steps=10, vertex_frequency=50.0)
        viewer.show(Subject(two_missions, "test"), playback=playback)
        viewer.set_step(4)
        page = page_state(viewer)
        assert max(page.steps()) > 4
        assert (
            page.steps(visible_only=True) == {step for step in page.steps() if step <= 4} != set()
        )
        assert "landmarks" not in page.layers
        viewer.set_step(2)
        page = page_state(viewer)
        assert (
            page.steps(visible_only=True) == {step for step in page.steps() if step <= 2} != set()
        )
        viewer.set_playing(True)
        assert wait_until(lambda: viewer.player is None)
        # it has come to the end, where the whole map is shown
        assert wait_until(lambda: "landmarks" in page_state(viewer).layers)
    finally:
        viewer.stop()


def test_clouds_and_images_come_with_their_vertices(two_missions: VIMap) -> None:
    viewer = Viewer(0)
    image = np.full((4, 4, 3), 9, dtype=np.uint8)
    asked: list[int] = []

    def image_of(row: int) -> np.ndarray | None:
        asked.append(row)
        return image if row == 3 else None

    clouds = tuple(Cloud("scan", np.full((5, 3), float(v)), vertex=v) for v in (0, 6, 11))
    try:
        subject = Subject(two_missions, "test", clouds=clouds, images=image_of)
        viewer.show(subject, playback=PlaybackOptions(steps=11))
        viewer.set_step(3)
        player = viewer.player
        assert player is not None
        head = player.head()
        assert asked[-1] == head == player.timeline.head[3, 0]
        page = page_state(viewer)
        assert ("data:image/jpeg" in page.html) == (head == 3)
        assert "cloud_0" not in page.layers
        steps = [int(player.timeline.vertex_step[v]) for v in (0, 6, 11)]
        assert len(set(steps)) == 3
        clouds_of_steps = {path for path in page.nodes if "/cloud_" in path}
        assert clouds_of_steps == {f"/play/{step}/cloud_{n}" for n, step in enumerate(steps)}
        viewer.set_step(11)
        page = page_state(viewer)
        assert "cloud_0" in page.layers
        assert "data:image" not in page.html
    finally:
        viewer.stop()


def test_the_time_line_plots_the_chosen_mission(two_missions: VIMap) -> None:
    viewer = Viewer(0)
    try:
        options = PlaybackOptions(steps=10)
        viewer.show(Subject(two_missions, "test"), playback=options)
        viewer.set_step(4)
        seconds = step_seconds(viewer.drawing, options)
        line = f"M{1000.0 * seconds[4] / seconds[10]:.1f} 0V100"
        first = page_state(viewer)
        chooser = first.control(label="plots of")
        assert len(chooser["options"]) == 2
        assert chooser["value"] == chooser["options"][0]
        assert line in first.html
        assert "landmarks</span>" in first.html
        viewer.playback.choose_mission(chooser["options"][1])
        second = page_state(viewer)
        assert line in second.html
        assert second.html != first.html
        viewer.set_step(10)
        assert "0V100" not in page_state(viewer).html
    finally:
        viewer.stop()


@pytest.mark.parametrize("has_camera", [True, False])
def test_the_view_rides_along(two_missions: VIMap, has_camera: bool) -> None:
    vi_map = two_missions if has_camera else two_missions.replace(sensors=SensorSet())
    drawing = make_checked_drawing(Subject(vi_map))
    camera = SimpleNamespace(position=np.zeros(3), look_at=np.zeros(3))
    ride(camera, drawing, 5, INSIDE)
    assert np.linalg.norm(camera.position - drawing.p_vertices[5]) < 0.2
    forward = camera.look_at - camera.position
    forward = forward / np.linalg.norm(forward)
    path = drawing.p_vertices[6] - drawing.p_vertices[4]
    if has_camera:  # it looks along z of the camera, which is that of the IMU here
        expected = so3.rotate(vi_map.T_G_I[5, :4], np.array([0.0, 0.0, 1.0]))
    else:
        expected = path / np.linalg.norm(path)
    np.testing.assert_allclose(forward, expected, atol=1e-6)
    ride(camera, drawing, 5, BEHIND)
    assert camera.position[2] > drawing.p_vertices[5, 2]
    seen = camera.look_at - camera.position
    assert seen[:2] @ expected[:2] > 0.0


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_the_page_carries_our_script(viewer: Viewer, encoding: str) -> None:
    request = urllib.request.Request(viewer.url, headers={"Accept-Encoding": encoding})
    with urllib.request.urlopen(request, timeout=20.0) as answer:
        body = answer.read()
        assert answer.headers["Content-Length"] == str(len(body))
    page = gzip.decompress(body) if encoding == "gzip" else body
    assert page_script().encode() in page
    assert page.index(b"<head>") < page.index(page_script().encode()) < page.index(b"</head>")


def test_points_are_sent_in_an_order_whose_beginning_is_spread() -> None:
    sent: list[tuple[np.ndarray, np.ndarray]] = []
    scene = SimpleNamespace(
        add_point_cloud=lambda _, p, colours, **__: sent.append((p, colours)),
    )
    rows = np.arange(1000)
    p = np.stack([rows, rows, rows], axis=1).astype(np.float32)
    colour = np.stack([rows % 256, rows // 256, 0 * rows], axis=1).astype(np.uint8)
    server: Any = SimpleNamespace(scene=scene)
    add_part(server, "/cloud", Points(p, colour, rows, 0.1))
    ((points, colours),) = sent
    order = points[:, 0].astype(int)
    assert sorted(order) == list(rows)
    np.testing.assert_array_equal(colours, colour[order])
    assert np.bincount(order[:200] // 100, minlength=10).min() >= 8


def test_live_updates_wait_for_a_page(viewer: Viewer, two_missions: VIMap) -> None:
    def never() -> VIMap:
        raise AssertionError("nobody looks")

    assert viewer.pages == 0
    assert not viewer.follow_live(never)


def test_ten_pages_and_one_that_comes_back_show_the_map_of_now(viewer: Viewer) -> None:
    other = walk_map(vertices=20, seed=7)
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(open_page(viewer)) for _ in range(10)]
        for page in pages:
            read_until(page, is_replayed)
        pages[0].close()  # its machine sleeps
        viewer.set_step(100)
        viewer.set_playing(True)
        viewer.follow(Subject(other, "other"))  # while it plays
        assert viewer.wait(20.0)
        assert viewer.player is None
        assert not viewer.playback.time_line.is_playing
        for page in pages[1:]:
            read_until(page, lambda m: "20 vertices" in str(m.get("updates", "")))
        back = page_state(viewer)
    mission = to_hex(other.missions.id[0])
    assert {key for layer, key in back.drawn if layer == "trajectories"} == {mission}
    assert back.steps() == set()


def test_another_map_begins_with_its_own_layers(viewer: Viewer) -> None:
    options = VisualizationOptions(check_landmark_constrained=False)
    viewer.set_layer("landmarks", False)
    viewer.show(Subject(walk_map(seed=5), "other", options))
    assert "landmarks" in viewer.visible_layers
    assert viewer.scene is not None
    assert viewer.scene.title == "other"


def test_what_a_page_asks_for_in_vain_is_said(caplog: pytest.LogCaptureFixture) -> None:
    said: list[str] = []

    def fail(event: object) -> None:
        raise RuntimeError("broken")

    callback = by_user(threading.RLock(), fail, said.append)
    callback(SimpleNamespace(client_id=None))  # what the program itself does is none of a page's
    assert said == []
    callback(SimpleNamespace(client_id=1))
    assert said == ["this could not be done: the log file has the reason"]
    assert "RuntimeError: broken" in caplog.text
