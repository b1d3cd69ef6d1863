"""The viewer without a browser: what it serves, refuses, follows, and leaves alone."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from maplab_py.errors import UserError
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.panel import by_user
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.layers.clouds import Cloud
from maplab_py.viewer.options import PlaybackOptions, VisualizationOptions
from maplab_py.vimap import VIMap
from maplab_py.vimap.merge import merge_maps
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
    assert viewer.server._share_tunnel is None


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
        time.sleep(0.2)
    viewer.stop()
    viewer.stop()
    time.sleep(0.2)
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
    nodes = viewer._nodes
    before = {key: node.part for key, node in nodes._nodes.items()}
    viewer.follow(subject.replace(vi_map=changed))
    assert viewer.wait(10.0)
    after = {key: node.part for key, node in nodes._nodes.items()}
    assert after.keys() == before.keys()
    first = f"{first_ids[0, 0]:016x}{first_ids[0, 1]:016x}"
    for layer in ("trajectories", "vertices"):
        assert after[layer, first] is before[layer, first]
    sent = {key for key in after if after[key] is not before[key]}
    layers = {layer for layer, _ in sent}
    assert layers == {"trajectories", "vertices", "landmarks", "loop_closures"}


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
    drawn = {layer for layer, _ in viewer._nodes._nodes}
    assert "landmarks" not in drawn
    assert "imu_edges" in drawn
    viewer.set_missions({second})
    assert first not in {mission for _, mission in viewer._nodes._nodes}
    viewer.follow(Subject(_moved(two_missions, 1.0), "test"))  # choices outlive an update
    assert viewer.wait(10.0)
    drawn = {layer for layer, _ in viewer._nodes._nodes}
    assert "landmarks" not in drawn
    assert first not in {mission for _, mission in viewer._nodes._nodes}


def test_colouring_changes_the_legend(viewer: Viewer) -> None:
    viewer.set_colouring("height")
    assert viewer.wait(10.0)
    assert "height" in viewer._panel.legend.content
    assert viewer._panel.colouring.value == "height"
    viewer.set_colouring("quality")
    assert viewer.wait(10.0)
    assert "not judged" in viewer._panel.legend.content


def test_playing_shows_the_map_grow(two_missions: VIMap) -> None:
    viewer = Viewer(0)
    try:
        playback = PlaybackOptions(steps=10, vertex_frequency=50.0)
        viewer.show(Subject(two_missions, "test"), playback=playback)
        viewer.set_step(4)
        player = viewer.player
        assert player is not None
        shown = {step for step, handles in player._chunks.items() if handles[0].visible}
        assert shown == {step for step in player._chunks if step <= 4}
        assert "landmarks" not in {layer for layer, _ in viewer._nodes._nodes}
        viewer.set_step(2)
        shown = {step for step, handles in player._chunks.items() if handles[0].visible}
        assert shown == {step for step in player._chunks if step <= 2}
        viewer.set_playing(True)
        deadline = time.monotonic() + 30.0
        while viewer.player is not None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert viewer.player is None  # it has come to the end, where the whole map is shown
        with viewer._lock:  # until the step that ended it is done
            pass
        assert "landmarks" in {layer for layer, _ in viewer._nodes._nodes}
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
        subject = Subject(two_missions, "test", clouds=clouds)
        viewer.show(subject, playback=PlaybackOptions(steps=11), image_of=image_of)
        viewer.set_step(3)
        player = viewer.player
        assert player is not None
        head = player.head()
        assert asked[-1] == head == player.timeline.head[3, 0]
        assert viewer._panel.image.visible == (head == 3)
        assert "cloud_0" not in {layer for layer, _ in viewer._nodes._nodes}
        steps = [int(player.timeline.vertex_step[v]) for v in (0, 6, 11)]
        named = [
            [h.name for h in player._chunks[step] if "cloud" in h.name]
            for step in sorted(set(steps))
        ]
        assert [len(names) for names in named] == [1, 1, 1]
        viewer.set_step(11)
        assert "cloud_0" in {layer for layer, _ in viewer._nodes._nodes}
        assert not viewer._panel.image.visible
    finally:
        viewer.stop()


def test_live_updates_wait_for_a_page(viewer: Viewer, two_missions: VIMap) -> None:
    def never() -> VIMap:
        raise AssertionError("nobody looks")

    assert viewer.pages == 0
    assert not viewer.follow_live(never)


def test_pages_may_come_and_go(viewer: Viewer, two_missions: VIMap) -> None:
    protocol = f"viser-v{viser.__version__}"
    url = viewer.url.replace("http", "ws", 1)
    stop = threading.Event()

    def visit() -> None:
        while not stop.is_set():
            with connect(url, subprotocols=[protocol], close_timeout=0.1) as connection:
                connection.recv(timeout=5.0)
                connection.socket.shutdown(socket.SHUT_RDWR)  # as a killed browser does

    visitors = [threading.Thread(target=visit) for _ in range(5)]
    for visitor in visitors:
        visitor.start()
    for step in range(10):
        viewer.follow(Subject(_moved(two_missions, 0.1 * step), "test"))
        viewer.set_layer("imu_edges", step % 2 == 0)
        time.sleep(0.05)
    stop.set()
    for visitor in visitors:
        visitor.join(timeout=20.0)
    assert viewer.wait(10.0)
    with connect(url, subprotocols=[protocol]) as connection:
        assert connection.recv(timeout=5.0)


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
