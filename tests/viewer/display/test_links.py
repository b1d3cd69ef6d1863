"""Links to a view: what they hold, and what a page that is opened by one shows."""

import contextlib
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import msgspec.msgpack
import numpy as np
import pytest

from maplab_py.errors import UserError
from maplab_py.viewer.building import Subject
from maplab_py.viewer.display.links import (
    KEY,
    MAX_CHARACTERS,
    SharedView,
    link_text,
    map_code,
    read_link,
)
from maplab_py.viewer.display.viewer import Viewer
from maplab_py.viewer.picking import Pick
from maplab_py.viewer.scene import Entity
from maplab_py.vimap.ids import to_hex
from tests.support.waiting import wait_until
from tests.viewer.display.page_messages import is_replayed, open_page, read_until
from tests.vimap.builders import walk_map

MAP = walk_map(seed=1)
_QUESTION = "LocalStorageGetItemRequestMessage"
CAMERA = np.array([[1.0, -2.5, 3.25], [0.0, 0.125, -1.0]])


class FakePage:
    """A page with an address, as the viewer sees it."""

    def __init__(self, link: str = "") -> None:
        self.link = link
        self.told: list[str] = []
        self.camera = self.local_storage = self
        self.position, self.look_at = CAMERA

    def get_item(self, key: str, timeout: float) -> str:
        assert key == KEY
        assert timeout > 0.0
        return self.link

    def set_item(self, key: str, value: str) -> None:
        assert key == KEY
        self.link = value

    def atomic(self) -> Any:
        return contextlib.nullcontext()

    def add_notification(self, title: str, body: str, auto_close_seconds: float) -> None:
        assert title == "Link"
        assert auto_close_seconds > 0.0
        self.told.append(body)


@pytest.fixture(scope="module")
def running() -> Iterator[Viewer]:
    viewer = Viewer(0)
    yield viewer
    viewer.stop()


@pytest.fixture
def viewer(running: Viewer) -> Viewer:
    """The viewer as it is at first."""
    running.show(Subject(MAP, "test"))
    return running


def test_a_link_opens_the_view_that_was_copied(viewer: Viewer) -> None:
    viewer.set_layers({"trajectories", "imu_edges"})
    viewer.select(Pick(Entity.VERTEX, 3, np.zeros(3), 0.0))
    page = FakePage()
    viewer.links.copy(page)
    assert page.told == ["copied: it is the address of this page, too"]
    assert len(page.link) < 200

    viewer.show(Subject(MAP.replace(), "of another name"))
    viewer.selections.clear()
    assert "landmarks" in viewer.visible_layers
    opened = FakePage(page.link)
    opened.position, opened.look_at = np.ones((2, 3))
    viewer.links.restore(opened)
    assert opened.told == []
    np.testing.assert_allclose([opened.position, opened.look_at], CAMERA, atol=1e-3)
    assert viewer.visible_layers == {"trajectories", "imu_edges"}
    picked = viewer.selection.picked
    assert picked is not None
    assert (picked.entity, picked.row) == (Entity.VERTEX, 3)


def test_pages_without_a_link_open_as_ever(viewer: Viewer) -> None:
    page, before = FakePage(), viewer.visible_layers
    viewer.links.restore(page)
    assert page.told == []
    assert viewer.visible_layers == before


@pytest.mark.parametrize(
    "link",
    [
        "nonsense",
        "map=0&camera=1,2,3,4,5,6&layers=",
        "map=0&camera=1,2,3&layers=&pick=",
        "map=0&camera=1,2,3,4,5,x&layers=&pick=",
        "map=0&camera=1,2,3,4,5,nan&layers=&pick=",
        "map=0&camera=1,2,3,4,5,1e9&layers=&pick=",
        "map=0&camera=1,2,3,1,2,3&layers=&pick=",
        "map=0&camera=1,2,3,4,5,6&layers=&pick=&more=1",
        "map=0&camera=1,2,3,4,5,6&pick=&layers=" + MAX_CHARACTERS * "a",
        "%00%ff&&",
    ],
)
def test_damaged_links_are_told_and_change_nothing(viewer: Viewer, link: str) -> None:
    page, before = FakePage(link), viewer.visible_layers
    viewer.links.restore(page)
    assert page.told == ["this link is damaged: the page opens as without it"]
    np.testing.assert_array_equal(page.position, CAMERA[0])
    assert viewer.visible_layers == before


def test_links_of_other_maps_and_things_are_told(viewer: Viewer) -> None:
    page, before = FakePage("map=00000000&camera=1,2,3,4,5,6&layers=&pick="), viewer.visible_layers
    viewer.links.restore(page)
    assert page.told == ["this link is of a map with other missions: load it, then reload the page"]
    assert viewer.visible_layers == before

    code = map_code(viewer.drawing)
    page = FakePage(f"map={code}&camera=1,2,3,4,5,6&layers=vertices,soot&pick=")
    viewer.links.restore(page)
    assert page.told == ["this map has no layer soot"]
    assert viewer.visible_layers == {"vertices"}

    gone = to_hex(walk_map(seed=9).vertices.id[0])
    page = FakePage(f"map={code}&camera=1,2,3,4,5,6&layers=vertices&pick={gone}")
    viewer.links.restore(page)
    assert len(page.told) == 1
    assert page.told[0].startswith("no vertex, landmark, loop closure or mission has an id")
    np.testing.assert_array_equal(page.look_at, [4.0, 5.0, 6.0])


def test_a_link_before_the_map_is_told() -> None:
    viewer = Viewer(0)
    page = FakePage("map=00000000&camera=1,2,3,4,5,6&layers=&pick=")
    viewer.links.restore(page)
    viewer.links.copy(page)
    assert page.told == 2 * ["nothing is shown yet: visualize"]
    viewer.stop()


def _open(address: str, **headers: str) -> tuple[int, str]:
    request = urllib.request.Request(address, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20.0) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, ""


def test_an_address_of_an_id_selects_it(viewer: Viewer) -> None:
    """Ids that the console prints are links of this kind."""
    id_ = to_hex(MAP.landmarks.id[3])
    status, page = _open(f"{viewer.url}/go/{id_}")
    assert status == 200
    picked = viewer.selection.picked
    assert picked is not None
    assert (picked.entity, picked.row) == (Entity.LANDMARK, 3)
    # no page is open: this one becomes the viewer's
    shared = read_link(page.split("/#")[1].split("'")[0])
    assert shared.picked_id == id_
    np.testing.assert_allclose(shared.camera_G[1], MAP.p_G[3], atol=1e-3)
    viewer.selections.clear()
    for headers in ({"Sec-Fetch-Site": "cross-site"}, {"Host": f"evil.example:{viewer.port}"}):
        assert _open(f"{viewer.url}/go/{id_}", **headers)[0] == 403
    assert viewer.selection.picked is None
    assert "has an id that starts" in _open(f"{viewer.url}/go/{32 * 'f'}")[1]
    assert _open(f"{viewer.url}/go/../x")[0] != 403


def test_links_stay_short() -> None:
    names = tuple(f"a_layer_of_a_plugin_{k}" for k in range(100))
    with pytest.raises(UserError, match="100 layers are too many for a link: hide some"):
        link_text(SharedView("00000000", CAMERA, names))
    view = read_link(link_text(SharedView("00000000", CAMERA, ("a&b", "c"))))
    assert view.layers == ("a&b", "c")


def test_a_page_is_asked_for_its_address_and_moved(viewer: Viewer) -> None:
    """What a browser sends and hears: its first camera, the question for the address, the new camera."""
    link = f"map={map_code(viewer.drawing)}&camera=1,2,3,4,5,6&layers=vertices&pick="
    camera = {
        "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, -9.0, 0.0),
        "fov": 0.8, "near": 0.1, "far": 100.0, "image_height": 600, "image_width": 900,
        "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
    }  # fmt: skip
    with open_page(viewer) as page:
        read_until(page, is_replayed)
        page.send(msgspec.msgpack.encode(camera))
        asked = read_until(page, lambda m: m["type"] == _QUESTION and m["key"] == KEY)
        question = next(m for m in asked if m["type"] == _QUESTION and m["key"] == KEY)
        answer = {
            "type": "LocalStorageGetItemResponseMessage", "value": link, "error": None,
            "request_uuid": question["request_uuid"],
        }  # fmt: skip
        page.send(msgspec.msgpack.encode(answer))
        messages = read_until(page, lambda m: m["type"] == "SetCameraLookAtMessage")
        moved = next(m for m in messages if m["type"] == "SetCameraPositionMessage")
        np.testing.assert_allclose(moved["position"], np.array([1, 2, 3]) - viewer.drawing.origin_G)
        assert wait_until(lambda: viewer.visible_layers == {"vertices"}, 20.0)
